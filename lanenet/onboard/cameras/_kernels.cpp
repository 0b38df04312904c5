// Whether all blocks of a JPEG image are there: its Huffman codes are read, no pixel is computed. libjpeg, which OpenCV
// decodes with, shows an image that lost bytes all the same.
// Source: ITU-T T.81, annexes B (markers), C and F (codes of baseline images).

#include "../../perception/arguments.hpp"

#include <cstdint>

namespace {

enum Answer { kUnknown = -1, kBroken = 0, kWhole = 1 };

// Annex C: the codes of a length are consecutive numbers, and begin after those of the length before.
struct Codes {
  bool given = false;
  int count[17] = {}, first[17] = {}, at[17] = {};
  uint8_t symbols[256] = {};
};

struct Component {
  uint8_t id = 0;
  int blocks = 1;
  const Codes *dc = nullptr, *ac = nullptr;
};

int number(const uint8_t* at) { return at[0] << 8 | at[1]; }

// Entropy-coded bits up to a marker; a byte FF is followed by 00.
struct Bits {
  const uint8_t *at, *end;
  uint32_t held = 0;
  int have = 0;

  bool take(int count, uint32_t* value) {
    while (have < count) {
      if (at == end || (*at == 0xFF && (at + 1 == end || at[1] != 0))) return false;
      held = held << 8 | *at;
      at += *at == 0xFF ? 2 : 1;
      have += 8;
    }
    have -= count;
    *value = held >> have & ((1u << count) - 1);
    return true;
  }

  // The next symbol; -1 if the bits end or are no code.
  int symbol(const Codes& codes) {
    uint32_t bit;
    for (int length = 1, code = 0; length <= 16 && take(1, &bit); ++length) {
      code = code << 1 | static_cast<int>(bit);
      const int nth = code - codes.first[length];
      if (nth >= 0 && nth < codes.count[length]) return codes.symbols[codes.at[length] + nth];
    }
    return -1;
  }

  // Annex F: the size of the difference of the mean, then runs of zeros, each before a value of some size.
  bool block(const Component& of) {
    uint32_t value;
    const int mean = symbol(*of.dc);
    if (mean < 0 || mean > 11 || !take(mean, &value)) return false;
    for (int k = 1; k < 64; ++k) {
      const int next = symbol(*of.ac), size = next & 15;
      if (next < 0) return false;
      if (next == 0) return true;
      if (size == 0 && next != 0xF0) return false;
      k += next >> 4;
      if (k > 63 || !take(size, &value)) return false;
    }
    return true;
  }

  bool restart(int nth) {
    have = 0;
    while (end - at > 2 && at[0] == 0xFF && at[1] == 0xFF) ++at;
    if (end - at < 2 || at[0] != 0xFF || at[1] != (0xD0 | (nth & 7))) return false;
    at += 2;
    return true;
  }
};

bool read_codes(const uint8_t* at, const uint8_t* end, Codes* tables) {
  while (at < end) {
    if (end - at < 17 || (at[0] & 0xEC)) return false;
    Codes& codes = tables[(at[0] >> 4) * 4 + (at[0] & 3)];
    int code = 0, total = 0;
    for (int length = 1; length <= 16; ++length) {
      codes.count[length] = at[length], codes.first[length] = code, codes.at[length] = total;
      code = (code + at[length]) << 1, total += at[length];
    }
    if (total > 256 || end - at < 17 + total) return false;
    for (int k = 0; k < total; ++k) codes.symbols[k] = at[17 + k];
    codes.given = true;
    at += 17 + total;
  }
  return true;
}

Answer look(const uint8_t* at, const uint8_t* end) {
  if (end - at < 4 || at[0] != 0xFF || at[1] != 0xD8) return kBroken;
  Codes tables[8];
  Component components[4];
  int n = 0, columns = 0, rows = 0, interval = 0, wide = 1, high = 1;
  for (at += 2;;) {
    while (end - at > 4 && at[0] == 0xFF && at[1] == 0xFF) ++at;
    if (end - at < 4 || at[0] != 0xFF) return kBroken;
    const uint8_t mark = at[1], *body = at + 4, *next = at + 2 + number(at + 2);
    if (next < body || next > end) return kBroken;
    at = next;
    if (mark == 0xC4) {
      if (!read_codes(body, next, tables)) return kBroken;
    } else if (mark == 0xC0 || mark == 0xC1) {
      if (next - body < 6 || body[5] < 1 || body[5] > 4 || next - body < 6 + 3 * body[5]) return kBroken;
      if (body[0] != 8) return kUnknown;
      rows = number(body + 1), columns = number(body + 3), n = body[5];
      for (int k = 0; k < n; ++k) {
        const int across = body[7 + 3 * k] >> 4, down = body[7 + 3 * k] & 15;
        if (across < 1 || across > 4 || down < 1 || down > 4) return kBroken;
        components[k].id = body[6 + 3 * k], components[k].blocks = n == 1 ? 1 : across * down;
        if (n > 1) wide = across > wide ? across : wide, high = down > high ? down : high;
      }
    } else if (mark >= 0xC2 && mark <= 0xCF && mark != 0xCC && mark != 0xC8) {
      return kUnknown;  // progressive, lossless or arithmetic
    } else if (mark == 0xDD) {
      if (next - body < 2) return kBroken;
      interval = number(body);
    } else if (mark == 0xDA) {
      if (n == 0 || next - body < 1 || next - body < 1 + 2 * body[0]) return kBroken;
      if (body[0] != n) return kUnknown;  // one component after the other
      for (int k = 0; k < n; ++k) {
        const int dc = body[2 + 2 * k] >> 4, ac = body[2 + 2 * k] & 15;
        if (body[1 + 2 * k] != components[k].id || dc > 3 || ac > 3) return kBroken;
        // Cameras may leave out the tables that are usual.
        if (!tables[dc].given || !tables[4 + ac].given) return kUnknown;
        components[k].dc = &tables[dc], components[k].ac = &tables[4 + ac];
      }
      break;
    }
  }
  const int64_t across = (columns + 8 * wide - 1) / (8 * wide), down = (rows + 8 * high - 1) / (8 * high);
  if (across == 0 || down == 0) return kUnknown;
  Bits bits{at, end};
  for (int64_t unit = 0; unit < across * down; ++unit) {
    if (interval && unit && unit % interval == 0 && !bits.restart(static_cast<int>(unit / interval - 1)))
      return kBroken;
    for (int k = 0; k < n; ++k)
      for (int block = 0; block < components[k].blocks; ++block)
        if (!bits.block(components[k])) return kBroken;
  }
  return kWhole;
}

PyObject* whole(PyObject*, PyObject* args) {
  Buffer data;
  if (!PyArg_ParseTuple(args, "y*", &data.view)) return nullptr;
  const uint8_t* begin = data.as<uint8_t>();
  return PyLong_FromLong(look(begin, begin + data.size<uint8_t>()));
}

PyMethodDef methods[] = {
    {"whole", whole, METH_VARARGS, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_kernels", nullptr, 0, methods, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__kernels() { return PyModuleDef_Init(&module); }
