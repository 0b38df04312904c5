// A compact network: what network.py reads out of an ONNX file, from a raster to points, in single precision. The sums
// are in an order of their own, so that the answers are those of onnxruntime but for the last digits (build with
// -ffp-contract=fast). Arrays come as contiguous buffers, whose types network.py sees to.

#include "../../arguments.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <exception>
#include <vector>

// The loops are for processors that multiply and add in one step: of x86-64 those since 2013, see is_fast(). What they
// call has to be compiled for these, too.
#if defined(__x86_64__)
#define FAST __attribute__((target("avx2,fma")))
#else
#define FAST
#endif
#define WITHIN FAST inline __attribute__((always_inline))

namespace {

// Eight numbers at a time, wherever they lie.
typedef float Eight __attribute__((vector_size(32), aligned(4), may_alias));

// Filters and places at a time: their sums fill the registers; points.
constexpr int kLanes = 16, kSpots = 4, kPoints = 6;
// What is at most: of a raster's window (see geometry/birdseye.py), and far beyond any network of ours; values of a
// map, so that none is counted beyond an int.
constexpr int kMostCells = 2048, kMostPlanes = 8, kMostSize = 16, kMostLayers = 16, kMostChannels = 4096;
constexpr Py_ssize_t kMostValues = 1 << 26;

// The sums of 16 filters.
struct Sums {
  Eight low, high;
};

WITHIN void read(const float* from, Sums& to) {
  to.low = *reinterpret_cast<const Eight*>(from), to.high = *reinterpret_cast<const Eight*>(from + 8);
}

WITHIN void write(const Sums& from, float* to) {
  *reinterpret_cast<Eight*>(to) = from.low, *reinterpret_cast<Eight*>(to + 8) = from.high;
}

WITHIN void add(float value, const float* weights, Sums& to) {
  to.low += value * *reinterpret_cast<const Eight*>(weights);
  to.high += value * *reinterpret_cast<const Eight*>(weights + 8);
}

WITHIN void take_positive(Sums& sums) {
  const Eight nothing{};
  sums.low = sums.low > nothing ? sums.low : nothing, sums.high = sums.high > nothing ? sums.high : nothing;
}

// Feature maps: the channels of a place lie side by side, and around the places lies a border of zeros. A plain place
// is what an empty raster would give far from its border, as most of them are: all plain ones are alike.
struct Features {
  std::vector<float> values;
  std::vector<std::uint8_t> plain;
  int rows = 0, columns = 0, channels = 0;

  // Every place is written in each frame, and the border never: it stays as it was made.
  void reset(int new_rows, int new_columns, int new_channels) {
    if (rows == new_rows && columns == new_columns && channels == new_channels) return;
    rows = columns = channels = 0;  // also if there is no memory
    values.assign(static_cast<size_t>(new_rows + 2) * (new_columns + 2) * new_channels, 0.0f);
    plain.assign(static_cast<size_t>(new_rows + 2) * (new_columns + 2), 0);
    rows = new_rows, columns = new_columns, channels = new_channels;
  }
  int row_length() const { return (columns + 2) * channels; }
  float* at(int row, int column) { return values.data() + (row + 1) * row_length() + (column + 1) * channels; }
  std::uint8_t& is_plain(int row, int column) { return plain[(row + 1) * (columns + 2) + column + 1]; }
};

// The first layer: a convolution of a raster few of whose cells hold anything.
struct FirstLayer {
  const std::uint8_t *raster, *nothing;  // planes x rows x columns; of each plane the byte that stands for 0
  const float *values, *weights, *bias;  // of each plane and byte; by block of 16 filters: size x size x planes x 16
  int planes, rows, columns, size, stride, pad;
};

// Marks the cells that hold something: not the byte that stands for 0 in their plane. `filled` is 0 before.
FAST void find_cells(const std::uint8_t* __restrict raster, const std::uint8_t* nothing, int planes, int cells,
                     std::uint8_t* __restrict filled) {
  for (int p = 0; p < planes; ++p, raster += cells) {
    const std::uint8_t zero = nothing[p];
    for (int i = 0; i < cells; ++i) filled[i] |= raster[i] ^ zero;
  }
}

// Adds a cell to all windows in which it lies.
WITHIN void add_cell(const FirstLayer& l, int row, int column, Features& out) {
  float values[kMostPlanes];
  for (int p = 0; p < l.planes; ++p)
    values[p] = l.values[256 * p + l.raster[(p * l.rows + row) * l.columns + column]];
  const int bottom = (row + l.pad) / l.stride, right = (column + l.pad) / l.stride;
  for (int y = bottom, down = row + l.pad - bottom * l.stride; y >= 0 && down < l.size; --y, down += l.stride) {
    if (y >= out.rows) continue;
    for (int x = right, aside = column + l.pad - right * l.stride; x >= 0 && aside < l.size; --x, aside += l.stride) {
      if (x >= out.columns) continue;
      const float* weights = l.weights + (down * l.size + aside) * l.planes * kLanes;
      float* to = out.at(y, x);
      out.is_plain(y, x) = 0;
      for (int f = 0; f < out.channels; f += kLanes, to += kLanes, weights += l.size * l.size * l.planes * kLanes) {
        Sums sums;
        read(to, sums);
        for (int p = 0; p < l.planes; ++p) add(values[p], weights + p * kLanes, sums);
        write(sums, to);
      }
    }
  }
}

FAST void convolve_raster(const FirstLayer& l, Features& out) {
  const int cells = l.rows * l.columns;
  for (int y = 0; y < out.rows; ++y)
    for (int x = 0; x < out.columns; ++x) {
      std::copy_n(l.bias, out.channels, out.at(y, x));
      out.is_plain(y, x) = 1;
    }
  static std::vector<std::uint8_t> filled;  // kept from frame to frame
  filled.assign(cells + 8, 0);
  find_cells(l.raster, l.nothing, l.planes, cells, filled.data());
  for (int begin = 0; begin < cells; begin += 8) {
    std::uint64_t eight;
    std::memcpy(&eight, filled.data() + begin, 8);
    if (!eight) continue;
    for (int i = begin; i < begin + 8; ++i)
      if (filled[i]) add_cell(l, i / l.columns, i % l.columns, out);
  }
  for (float& value : out.values) value = std::max(value, 0.0f);
}

// Lists the places that a layer has to work out, and those that are as its first plain one.
void list_places(Features& in, Features& out, std::vector<int>& worked_out, std::vector<int>& plain) {
  worked_out.clear(), plain.clear();
  for (int y = 0; y < out.rows; ++y)
    for (int x = 0; x < out.columns; ++x) {
      std::uint8_t all = 1;
      for (int row = 2 * y - 1; row <= 2 * y + 1; ++row)
        for (int column = 2 * x - 1; column <= 2 * x + 1; ++column) all &= in.is_plain(row, column);
      out.is_plain(y, x) = all;
      if (all) plain.push_back(y * out.columns + x);
      if (!all || plain.size() == 1) worked_out.push_back(y * out.columns + x);
    }
}

// 3 x 3 filters with a stride of two, and the positive part; some places at a time.
FAST void convolve(Features& in, const float* weights, const float* bias, Features& out) {
  static std::vector<int> places, plain;  // kept from frame to frame
  list_places(in, out, places, plain);
  const int last = static_cast<int>(places.size()) - 1, count = 3 * in.channels;
  const auto place_of = [&](int place) { return out.at(place / out.columns, place % out.columns); };
  for (int f = 0; f < out.channels; f += kLanes, weights += 3 * count * kLanes)
    for (int begin = 0; begin <= last; begin += kSpots) {
      const float* from[kSpots];
      float* to[kSpots];
      Sums sums[kSpots];
      for (int s = 0; s < kSpots; ++s) {
        const int place = places[std::min(begin + s, last)];
        from[s] = in.at(2 * (place / out.columns) - 1, 2 * (place % out.columns) - 1), to[s] = place_of(place) + f;
        read(bias + f, sums[s]);
      }
      const float* w = weights;
      for (int down = 0; down < 3; ++down) {
        for (int k = 0; k < count; ++k, w += kLanes)
          for (int s = 0; s < kSpots; ++s) add(from[s][k], w, sums[s]);
        for (const float*& row : from) row += in.row_length();
      }
      for (int s = 0; s < kSpots; ++s) take_positive(sums[s]), write(sums[s], to[s]);
    }
  for (size_t i = 1; i < plain.size(); ++i) std::copy_n(place_of(plain[0]), out.channels, place_of(plain[i]));
}

// A fully connected layer of all that a map holds.
FAST void connect(Features& in, const float* weights, const float* bias, int outputs, float* out) {
  const int count = in.columns * in.channels;
  for (int f = 0; f < outputs; f += kLanes) {
    Sums sums;
    read(bias + f, sums);
    for (int y = 0; y < in.rows; ++y) {
      const float* values = in.at(y, 0);
      for (int k = 0; k < count; ++k, weights += kLanes) add(values[k], weights, sums);
    }
    write(sums, out + f);
  }
}

// Points, their sigmas and the presence of both lines, from the last layer's outputs: a distribution over places for
// each point, its log sigma, and the log odds of both lines. `tail` as in network.py.
void answer(const float* outputs, const float* tail, int bins, double* found) {
  const float *factors = tail + 2, *places = factors + kPoints, *spread = outputs + kPoints * bins;
  for (int i = 0; i < kPoints; ++i, outputs += bins) {
    const float most = *std::max_element(outputs, outputs + bins);
    double total = 0.0, mean = 0.0;
    for (int k = 0; k < bins; ++k) {
      const double likely = std::exp(outputs[k] - most);
      total += likely, mean += likely * places[k];
    }
    found[i] = mean / total;
    found[kPoints + i] = std::exp(tail[0] + tail[1] * std::tanh(spread[i] / tail[1])) * factors[i];
  }
  for (int side = 0; side < 2; ++side) found[2 * kPoints + side] = 1.0 / (1.0 + std::exp(-spread[kPoints + side]));
}

// --- Python ---

// Adds what a lane's width adds to the biases, by how near it is to each of some widths.
void tell_width(double width_cm, double sigma, const Buffer& log_widths, const float* by_width,
                std::vector<float>& biases) {
  const double log_width = std::log(width_cm);
  for (Py_ssize_t k = 0; k < log_widths.size<float>(); ++k, by_width += biases.size()) {
    const double off = (log_width - log_widths.as<float>()[k]) / sigma;
    const float near = static_cast<float>(std::exp(-0.5 * off * off));
    for (size_t i = 0; i < biases.size(); ++i) biases[i] += near * by_width[i];
  }
}

PyObject* run(PyObject*, PyObject* args) {
  Buffer raster, nothing, values, weights, biases, log_widths, by_width, channels, tail, found;
  FirstLayer l{};
  double width_cm, width_sigma;
  if (!PyArg_ParseTuple(args, "y*dy*y*y*y*y*y*y*y*dw*iiiiii", &raster.view, &width_cm, &nothing.view, &values.view,
                        &weights.view, &biases.view, &log_widths.view, &by_width.view, &channels.view, &tail.view,
                        &width_sigma, &found.view, &l.planes, &l.rows, &l.columns, &l.size, &l.stride, &l.pad))
    return nullptr;
  // Channels of the convolutions, hidden units, outputs.
  const int *sizes = channels.as<int>(), layers = static_cast<int>(channels.size<int>()) - 2;
  const auto within = [](int value, int least, int most) { return value >= least && value <= most; };
  bool sound = within(l.planes, 1, kMostPlanes) && within(l.rows, 1, kMostCells) &&
               within(l.columns, 1, kMostCells) && within(l.size, 1, kMostSize) && within(l.stride, 1, l.size) &&
               within(l.pad, 0, l.size - 1) && std::min(l.rows, l.columns) + 2 * l.pad >= l.size &&
               within(layers, 1, kMostLayers);
  for (int i = 0; sound && i < layers + 2; ++i) sound = within(sizes[i], 1, kMostChannels) && sizes[i] % kLanes == 0;
  if (!sound) return refuse("network: not one that this was compiled for");
  const int rows = (l.rows + 2 * l.pad - l.size) / l.stride + 1;
  const int columns = (l.columns + 2 * l.pad - l.size) / l.stride + 1;
  const int hidden = sizes[layers], outputs = sizes[layers + 1];
  const Py_ssize_t n_first = Py_ssize_t{l.planes} * l.size * l.size * sizes[0];
  Py_ssize_t n_weights = n_first, n_biases = sizes[0];
  int last_rows = rows, last_columns = columns;
  const auto fits = [&](int channels) {
    return Py_ssize_t{last_rows + 2} * (last_columns + 2) * channels <= kMostValues;
  };
  sound = fits(sizes[0]);
  for (int i = 1; i < layers; ++i) {
    n_weights += Py_ssize_t{9} * sizes[i - 1] * sizes[i], n_biases += sizes[i];
    last_rows = (last_rows + 1) / 2, last_columns = (last_columns + 1) / 2;
    sound &= fits(sizes[i]);
  }
  if (!sound) return refuse("network: not one that this was compiled for");
  const Py_ssize_t n_hidden = Py_ssize_t{last_rows} * last_columns * sizes[layers - 1] * hidden;
  const Py_ssize_t bins = tail.size<float>() - 2 - kPoints;
  if (raster.view.len != Py_ssize_t{l.planes} * l.rows * l.columns || nothing.view.len != l.planes ||
      values.size<float>() != 256 * l.planes ||
      weights.size<float>() != n_weights + n_hidden + Py_ssize_t{hidden} * outputs ||
      biases.size<float>() != n_biases + hidden + outputs ||
      by_width.size<float>() != log_widths.size<float>() * biases.size<float>() || bins < 1 || bins > outputs ||
      (kPoints * (bins + 1) + 2 + kLanes - 1) / kLanes * kLanes != outputs ||
      found.size<double>() != 2 * kPoints + 2)
    return refuse("network: raster, weights and answers differ in size");
  l.raster = raster.as<std::uint8_t>(), l.nothing = nothing.as<std::uint8_t>(), l.values = values.as<float>();
  l.weights = weights.as<float>();
  try {
    // Kept from frame to frame; one caller at a time: the interpreter's lock is held.
    static Features maps[kMostLayers], units;  // of each layer its own: they differ in size
    static std::vector<float> told, out;
    told.assign(biases.as<float>(), biases.as<float>() + biases.size<float>());
    if (width_cm > 0.0) tell_width(width_cm, width_sigma, log_widths, by_width.as<float>(), told);
    l.bias = told.data();
    maps[0].reset(rows, columns, sizes[0]);
    convolve_raster(l, maps[0]);
    const float *w = l.weights + n_first, *b = l.bias + sizes[0];
    for (int i = 1; i < layers; w += 9 * sizes[i - 1] * sizes[i], b += sizes[i], ++i) {
      Features &before = maps[i - 1], &after = maps[i];
      after.reset((before.rows + 1) / 2, (before.columns + 1) / 2, sizes[i]);
      convolve(before, w, b, after);
    }
    units.reset(1, 1, hidden);
    float* unit = units.at(0, 0);
    connect(maps[layers - 1], w, b, hidden, unit);
    for (int i = 0; i < hidden; ++i) unit[i] = std::max(unit[i], 0.0f);
    out.resize(outputs);
    connect(units, w + n_hidden, b + hidden, outputs, out.data());
    answer(out.data(), tail.as<float>(), static_cast<int>(bins), static_cast<double*>(found.view.buf));
  } catch (const std::exception&) {
    return PyErr_NoMemory();
  }
  Py_RETURN_NONE;
}

PyObject* is_fast(PyObject*, PyObject*) {
#if defined(__x86_64__)
  return PyBool_FromLong(__builtin_cpu_supports("fma") && __builtin_cpu_supports("avx2"));
#else
  Py_RETURN_TRUE;
#endif
}

PyMethodDef methods[] = {
    {"is_fast", is_fast, METH_NOARGS, nullptr},
    {"run", run, METH_VARARGS, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_kernels", nullptr, 0, methods, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__kernels() { return PyModuleDef_Init(&module); }
