// The board's protocol as a library: the test sets the clock.

#include <cstring>

#include "protocol.h"

extern "C" {

lanenet::Board* MakeBoard() { return new lanenet::Board; }
void DeleteBoard(lanenet::Board* board) { delete board; }

// Takes bytes at one moment; `replies` gets the lines that answer them.
void Take(lanenet::Board* board, const char* bytes, int length, uint32_t now_ms, char* replies) {
  *replies = 0;
  for (int i = 0; i < length; ++i)
    if (board->TakeByte(bytes[i], now_ms, replies)) replies += std::strlen(replies);
}

// A turn of the loop; `report` gets the report, if one is due. Returns the throttle's pulse.
int Turn(lanenet::Board* board, uint32_t now_ms, char* report) {
  if (!board->Tick(now_ms, report)) *report = 0;
  return board->throttle_us();
}
}
