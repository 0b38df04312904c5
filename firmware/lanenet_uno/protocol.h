// The board's side of the protocol in lanenet/onboard/actuators/serial_board.py, version 2, with the watchdog.
// Uses no Arduino header, so that it can be tested on a computer.

#ifndef LANENET_PROTOCOL_H
#define LANENET_PROTOCOL_H

#include <stdint.h>
#include <stdio.h>

namespace lanenet {

const uint8_t kVersion = 2;
// A command is good until this long after the report that it answers.
const uint8_t kCommandMs = 80;
const uint8_t kReportMs = 10;
// The longest line, without its end.
const uint8_t kMaxLine = 39;
// No pulse leaves this range, whatever a line says.
const uint16_t kShortestUs = 500, kLongestUs = 2500;

// CRC-8: polynomial 0x07, start 0, not reflected.
inline uint8_t Crc8(const char* text, uint8_t length) {
  uint8_t crc = 0;
  for (uint8_t i = 0; i < length; ++i) {
    crc ^= static_cast<uint8_t>(text[i]);
    for (uint8_t bit = 0; bit < 8; ++bit) crc = (crc & 0x80) ? (crc << 1) ^ 0x07 : crc << 1;
  }
  return crc;
}

// Appends the checksum and a line feed to `text`, which needs room for five more characters.
inline void Seal(char* text) {
  uint8_t length = 0;
  while (text[length]) ++length;
  snprintf(text + length, 5, "*%02X\n", Crc8(text, length));
}

class Board {
 public:
  // Takes one byte. Returns true when `reply` holds a line to send (kMaxLine + 2 characters at most).
  bool TakeByte(char byte, uint32_t now_ms, char* reply) {
    if (byte != '\n') {
      if (byte == '\r') return false;
      // A line that is too long is dropped at its end.
      if (length_ <= kMaxLine) line_[length_++] = byte;
      return false;
    }
    const uint8_t length = length_;
    length_ = 0;
    if (length == 0) return false;
    Line line;
    if (length > kMaxLine || !Parse(length, &line)) {
      ++refused_;
      return false;
    }
    if (line.letter == 'V') return Greet('V', reply);
    if (line.letter == 'N') {
      neutral_steering_us_ = line.steering_us;
      neutral_throttle_us_ = line.throttle_us;
      has_neutral_ = true;
      driving_ = false;
    } else if (has_neutral_ && now_ms - line.time_ms < kCommandMs) {
      steering_us_ = line.steering_us;
      throttle_us_ = line.throttle_us;
      sequence_ = line.sequence;
      command_ms_ = line.time_ms;
      driving_ = true;
    } else {
      ++refused_;
    }
    return false;
  }

  // Fills `reply` with the version: V answers a question, B tells that the board has started.
  bool Greet(char letter, char* reply) const {
    snprintf(reply, kMaxLine, "%c%u", letter, static_cast<unsigned>(kVersion));
    Seal(reply);
    return true;
  }

  // Called in every turn of the loop. Returns true when `reply` holds a report to send.
  bool Tick(uint32_t now_ms, char* reply) {
    // Unsigned subtraction stays correct when the clock wraps to 0 after 49 days.
    if (driving_ && now_ms - command_ms_ >= kCommandMs) driving_ = false;
    if (now_ms - last_report_ms_ < kReportMs) return false;
    last_report_ms_ = now_ms;
    snprintf(reply, kMaxLine, "A%lu,%u,%u,%u,%u,%u", static_cast<unsigned long>(now_ms),
             static_cast<unsigned>(sequence_), static_cast<unsigned>(refused_), driving_ ? 1u : 0u,
             static_cast<unsigned>(steering_us()), static_cast<unsigned>(throttle_us()));
    Seal(reply);
    return true;
  }

  bool driving() const { return driving_; }
  uint16_t steering_us() const { return driving_ ? steering_us_ : neutral_steering_us_; }
  uint16_t throttle_us() const { return driving_ ? throttle_us_ : neutral_throttle_us_; }

 private:
  struct Line {
    char letter;
    uint16_t steering_us, throttle_us, sequence;
    uint32_t time_ms;
  };

  static int8_t HexDigit(char c) {
    if (c >= '0' && c <= '9') return c - '0';
    if (c >= 'A' && c <= 'F') return c - 'A' + 10;
    return -1;
  }

  // Reads digits up to `end` or a comma; false if there are none, or the number is out of range.
  bool Number(uint8_t* at, uint8_t end, uint32_t least, uint32_t most, uint32_t* value) const {
    const uint8_t start = *at;
    for (*value = 0; *at < end && line_[*at] >= '0' && line_[*at] <= '9'; ++*at) {
      const uint8_t digit = line_[*at] - '0';
      if (*value > (most - digit) / 10) return false;
      *value = *value * 10 + digit;
    }
    return *at > start && *value >= least;
  }

  bool Pulse(uint8_t* at, uint8_t end, uint16_t* pulse_us) const {
    uint32_t value = 0;
    if (!Number(at, end, kShortestUs, kLongestUs, &value)) return false;
    *pulse_us = static_cast<uint16_t>(value);
    return true;
  }

  bool Comma(uint8_t* at, uint8_t end) const { return *at < end && line_[(*at)++] == ','; }

  bool Parse(uint8_t length, Line* line) const {
    if (length < 4 || line_[length - 3] != '*') return false;
    const int8_t high = HexDigit(line_[length - 2]), low = HexDigit(line_[length - 1]);
    const uint8_t end = length - 3;
    if (high < 0 || low < 0 || Crc8(line_, end) != high * 16 + low) return false;
    line->letter = line_[0];
    if (line->letter == 'V') return end == 1;
    if (line->letter != 'S' && line->letter != 'N') return false;
    uint8_t at = 1;
    if (!Pulse(&at, end, &line->steering_us) || !Comma(&at, end)) return false;
    if (!Pulse(&at, end, &line->throttle_us)) return false;
    if (line->letter == 'S') {
      uint32_t sequence = 0;
      if (!Comma(&at, end) || !Number(&at, end, 0, UINT16_MAX, &sequence)) return false;
      line->sequence = static_cast<uint16_t>(sequence);
      if (!Comma(&at, end) || !Number(&at, end, 0, UINT32_MAX, &line->time_ms)) return false;
    }
    return at == end;
  }

  char line_[kMaxLine + 1] = {0};
  uint8_t length_ = 0;
  uint16_t sequence_ = 0, refused_ = 0;
  bool has_neutral_ = false, driving_ = false;
  uint16_t neutral_steering_us_ = 1500, neutral_throttle_us_ = 1500;
  uint16_t steering_us_ = 1500, throttle_us_ = 1500;
  uint32_t command_ms_ = 0, last_report_ms_ = 0;
};

}  // namespace lanenet

#endif  // LANENET_PROTOCOL_H
