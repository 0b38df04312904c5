// An Uno in simavr that runs the sketch: the ATmega328P's serial line is stdin and stdout (a pseudo-terminal),
// and every pulse that starts on pin 9 or 10 becomes a line "t_s pin width_us period_us" on stderr. Simulated
// time keeps step with real time. Ends when stdin is closed. At SIGUSR1 the sketch hangs, with its interrupts off,
// until something resets the chip.
//
// simavr 1.6 does not take new compare values over while the timer runs up to ICR1, as the chip does at the end
// of each period. Hence the start of a pulse is seen on the pin, and its width is taken from the register.
//
//   avr_board sketch.elf

#include <poll.h>
#include <signal.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

// Addresses of the low bytes of timer 1's compare registers in the data memory of the ATmega328P.
enum { OCR1A = 0x88, OCR1B = 0x8A };

static avr_t *avr;
static int ready = 1;
static volatile sig_atomic_t asked_to_hang;
// The program's address and its two bytes there that a jump to itself replaces while the sketch hangs.
static avr_flashaddr_t hung_at;
static uint8_t hung_bytes[2];
static int hung;
static avr_cycle_count_t rise[2];

static double now_s(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return now.tv_sec + 1e-9 * now.tv_nsec;
}

static void on_byte(struct avr_irq_t *irq, uint32_t value, void *param) {
  (void)irq, (void)param;
  const char byte = (char)value;
  if (write(STDOUT_FILENO, &byte, 1) != 1) exit(0);
}

static void on_ready(struct avr_irq_t *irq, uint32_t value, void *param) {
  (void)irq, (void)value;
  ready = param != NULL;
}

static void on_pin(struct avr_irq_t *irq, uint32_t value, void *param) {
  (void)irq;
  const long which = (long)param;
  if (!value) return;
  const uint8_t *compare = avr->data + (which ? OCR1B : OCR1A);
  const double width_us = (compare[0] + 256 * compare[1] + 1) * 0.5;
  const double period_us = (avr->cycle - rise[which]) / 16.0;
  fprintf(stderr, "%.6f %ld %.1f %.0f\n", now_s(), 9 + which, width_us, period_us);
  rise[which] = avr->cycle;
}

static void on_signal(int number) {
  (void)number;
  asked_to_hang = 1;
}

static void hang(void) {
  hung_at = avr->pc;
  memcpy(hung_bytes, avr->flash + hung_at, 2);
  memcpy(avr->flash + hung_at, "\xFF\xCF", 2);
  avr->sreg[S_I] = 0;
  hung = 1;
}

int main(int argc, char **argv) {
  elf_firmware_t firmware;
  memset(&firmware, 0, sizeof firmware);
  if (argc != 2 || elf_read_firmware(argv[1], &firmware)) return 2;
  avr = avr_make_mcu_by_name("atmega328p");
  avr_init(avr);
  avr->frequency = 16000000;
  avr_load_firmware(avr, &firmware);
  avr->frequency = 16000000;
  uint32_t flags = 0;
  avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
  flags &= ~(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP);
  avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
  avr_irq_t *input = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_byte, NULL);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XON), on_ready, avr);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XOFF), on_ready, NULL);
  // Pins 9 and 10 of an Uno are PB1 and PB2.
  for (long which = 0; which < 2; ++which)
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 1 + which), on_pin, (void *)which);

  signal(SIGUSR1, on_signal);
  const double start_s = now_s();
  for (;;) {
    struct pollfd serial = {STDIN_FILENO, POLLIN, 0};
    while (ready && poll(&serial, 1, 0) > 0) {
      unsigned char byte;
      if (read(STDIN_FILENO, &byte, 1) != 1) return 0;
      avr_raise_irq(input, byte);
    }
    const avr_cycle_count_t until = (now_s() - start_s) * 16e6;
    if (avr->cycle >= until) {
      usleep(500);
      continue;
    }
    // A millisecond at most, so that input is looked at again when the computer was busy.
    const avr_cycle_count_t stop = avr->cycle + 16000 < until ? avr->cycle + 16000 : until;
    if (asked_to_hang && !hung) hang();
    while (avr->cycle < stop) {
      if (avr_run(avr) == cpu_Crashed) return 3;
      if (hung && avr->pc != hung_at) {
        memcpy(avr->flash + hung_at, hung_bytes, 2);
        hung = asked_to_hang = 0;
      }
    }
  }
}
