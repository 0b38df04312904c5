// Steering servo and motor controller of a 1:10 car on an Arduino Uno or Nano (ATmega328P, 16 MHz).
//
//   pin 9    signal of the steering servo
//   pin 10   signal of the electronic speed controller
//   GND      ground of both; the servo's supply comes from the speed controller, not from the board
//
// The computer sends lines over USB (protocol.h). 80 ms after the last report that a command answers the motor
// goes to neutral; the chip's own watchdog restarts a sketch that hangs, in neutral.
//
// Timer 1 makes both pulses, so they do not jitter while bytes arrive; no library is needed.

#include <avr/wdt.h>

#include "protocol.h"

namespace {

// Timer 1 counts half microseconds (16 MHz / 8) with a period of 20 ms: 50 pulses per second.
const uint16_t kCountsPerUs = 2;
const uint16_t kPeriodCounts = 20000 * kCountsPerUs;

lanenet::Board board;
char reply[lanenet::kMaxLine + 6];

void SetPulses() {
  // Both registers take effect together at the end of the period; an interrupt must not come between the
  // two bytes of either. The output falls one count after the match.
  const uint16_t steering = board.steering_us() * kCountsPerUs - 1;
  const uint16_t throttle = board.throttle_us() * kCountsPerUs - 1;
  noInterrupts();
  if (OCR1A != steering) OCR1A = steering;
  if (OCR1B != throttle) OCR1B = throttle;
  interrupts();
}

}  // namespace

// After its reset the watchdog still runs, at its shortest time. It is switched off before the first variable is
// set up: else it would cut every start short.
void StopWatchdog() __attribute__((naked, used, section(".init3")));
void StopWatchdog() {
  MCUSR = 0;
  wdt_disable();
}

void setup() {
  // Fast PWM up to ICR1 (mode 14), both outputs high from the start of the period to the match.
  TCCR1A = _BV(COM1A1) | _BV(COM1B1) | _BV(WGM11);
  TCCR1B = _BV(WGM13) | _BV(WGM12);
  ICR1 = kPeriodCounts - 1;
  TCNT1 = 0;
  SetPulses();
  pinMode(9, OUTPUT);
  pinMode(10, OUTPUT);
  TCCR1B |= _BV(CS11);
  Serial.begin(115200);
  board.Greet('B', reply);
  // The restart may have cut a line short.
  Serial.print('\n');
  Serial.print(reply);
  // A turn of the loop takes less than 5 ms, also when it waits for room in the output buffer.
  wdt_enable(WDTO_60MS);
}

void loop() {
  wdt_reset();
  while (Serial.available() > 0) {
    if (board.TakeByte(static_cast<char>(Serial.read()), millis(), reply)) Serial.print(reply);
  }
  // Leave the report out if the output buffer is full: waiting would stop the loop and the watchdog.
  if (board.Tick(millis(), reply) && Serial.availableForWrite() >= static_cast<int>(sizeof(reply))) {
    Serial.print(reply);
  }
  SetPulses();
}
