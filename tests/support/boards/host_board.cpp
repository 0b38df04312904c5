// The board's protocol on this computer: bytes in on stdin, bytes out on stdout (a pseudo-terminal), and on
// stderr a line "t_s steering_us throttle_us" whenever the pulses change. Ends when stdin is closed.
//
//   host_board [start_ms]    where the board's clock starts

#include <poll.h>
#include <time.h>
#include <unistd.h>

#include <cstdlib>
#include <cstring>

#include "protocol.h"

namespace {

double Now() {
  timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return now.tv_sec + 1e-9 * now.tv_nsec;
}

const double kBegun = Now();
uint32_t start_ms = 0;

uint32_t Millis() { return start_ms + static_cast<uint32_t>(1e3 * (Now() - kBegun)); }

void Send(const char* line) { (void)!write(STDOUT_FILENO, line, std::strlen(line)); }

}  // namespace

int main(int argc, char** argv) {
  if (argc > 1) start_ms = static_cast<uint32_t>(std::strtoul(argv[1], nullptr, 10));
  lanenet::Board board;
  char reply[lanenet::kMaxLine + 6];
  uint16_t steering_us = 0, throttle_us = 0;
  board.Greet('B', reply);
  Send(reply);
  for (;;) {
    pollfd input = {STDIN_FILENO, POLLIN, 0};
    if (poll(&input, 1, 1) > 0) {
      char bytes[256];
      const ssize_t count = read(STDIN_FILENO, bytes, sizeof bytes);
      if (count <= 0) return 0;
      for (ssize_t i = 0; i < count; ++i)
        if (board.TakeByte(bytes[i], Millis(), reply)) Send(reply);
    }
    if (board.Tick(Millis(), reply)) Send(reply);
    if (board.steering_us() != steering_us || board.throttle_us() != throttle_us) {
      steering_us = board.steering_us();
      throttle_us = board.throttle_us();
      char text[64];
      snprintf(text, sizeof text, "%.6f %u %u\n", Now(), steering_us, throttle_us);
      (void)!write(STDERR_FILENO, text, std::strlen(text));
    }
  }
}
