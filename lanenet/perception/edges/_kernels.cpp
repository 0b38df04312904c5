// Edge points, their places on the road, and the raster: canny.py, pixels.py, road.py and raster.py,
// compiled. What a step means and where it comes from stands there. Every number is rounded as NumPy and
// OpenCV round it, so that the bytes are equal: integers up to the edges, then double precision in the order
// of the Python code (build with -ffp-contract=off). Arrays come as contiguous buffers, whose types
// compiled.py sees to.

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <vector>

// On x86-64 the loops over pixels exist twice, and the processor chooses.
#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif
#if defined(__GNUC__)
#define PREFETCH(address) __builtin_prefetch(address)
#else
#define PREFETCH(address) (void)(address)
#endif

namespace {

using std::int16_t;
using std::int32_t;
using std::uint16_t;
using std::uint32_t;
using std::uint8_t;

constexpr int kPad = 2;        // pixels that a filter looks at beside a row
constexpr int kBlock = 16;     // pixels that are skipped together where nothing is strong
constexpr size_t kAhead = 16;  // edge points from a fetch to its use
constexpr int kTan22 = 13573;  // tan(22.5 degrees) in 15 bits, OpenCV's
constexpr double kTan22Exact = 0.41421356237309503;  // numpy.tan(pi / 8)
enum : uint8_t { kNone, kWeak, kEdge };              // marks of the hysteresis

// Memory that is kept from frame to frame.
struct Scratch {
  std::vector<uint8_t> channel[3], blurred[3], marks;
  std::vector<uint16_t> column_sum;
  std::vector<int16_t> smooth, difference, dx, dy, row[6], hue[4];
  std::vector<int32_t> magnitude[3], strongest[3], candidates, stack, sampled, ordered;
  std::vector<size_t> counts;
};

// Index beyond a border, as OpenCV's BORDER_REFLECT_101.
inline int reflect(int i, int n) { return i < 0 ? -i : i >= n ? 2 * (n - 1) - i : i; }

// Fill the pad on both sides of a row whose pixel 0 is at `row`.
template <class T>
inline void reflect_ends(T* row, int width) {
  for (int i = 1; i <= kPad; ++i) {
    row[-i] = row[reflect(-i, width)];
    row[width - 1 + i] = row[reflect(width - 1 + i, width)];
  }
}

WIDE void split(const uint8_t* bgr, int count, uint8_t* blue, uint8_t* green, uint8_t* red) {
  for (int i = 0; i < count; ++i) {
    blue[i] = bgr[3 * i];
    green[i] = bgr[3 * i + 1];
    red[i] = bgr[3 * i + 2];
  }
}

// OpenCV's gray, in place of green.
WIDE void mix_gray(const uint8_t* blue, uint8_t* green, const uint8_t* red, int count) {
  for (int i = 0; i < count; ++i)
    green[i] = static_cast<uint8_t>((3735 * blue[i] + 19235 * green[i] + 9798 * red[i] + 16384) >> 15);
}

// One row of the Gauss blur of 3 px (1 2 1) or 5 px (1 4 6 4 1) in both directions; rows from top to bottom.
WIDE void blur_row(const uint8_t* const rows[5], int size, int width, uint16_t* sums, uint8_t* out) {
  if (size == 3) {
    for (int i = 0; i < width; ++i) sums[i] = rows[1][i] + 2 * rows[2][i] + rows[3][i];
    reflect_ends(sums, width);
    for (int i = 0; i < width; ++i)
      out[i] = static_cast<uint8_t>(static_cast<uint16_t>(sums[i - 1] + 2 * sums[i] + sums[i + 1] + 8) >> 4);
  } else {
    for (int i = 0; i < width; ++i)
      sums[i] = rows[0][i] + 4 * (rows[1][i] + rows[3][i]) + 6 * rows[2][i] + rows[4][i];
    reflect_ends(sums, width);
    for (int i = 0; i < width; ++i)
      out[i] = static_cast<uint8_t>(static_cast<uint16_t>(sums[i - 2] + 4 * (sums[i - 1] + sums[i + 1]) +
                                                          6 * sums[i] + sums[i + 2] + 128) >>
                                    8);
  }
}

void blur(Scratch& s, const uint8_t* image, int height, int width, int size, uint8_t* out) {
  s.column_sum.resize(width + 2 * kPad);
  for (int v = 0; v < height; ++v) {
    const uint8_t* rows[5];
    for (int i = 0; i < 5; ++i) rows[i] = image + static_cast<size_t>(reflect(v + i - 2, height)) * width;
    blur_row(rows, size, width, s.column_sum.data() + kPad, out + static_cast<size_t>(v) * width);
  }
}

// One row of the Sobel responses.
WIDE void sobel_row(const uint8_t* above, const uint8_t* here, const uint8_t* below, int width,
                    int16_t* smooth, int16_t* difference, int16_t* dx, int16_t* dy) {
  for (int i = 0; i < width; ++i) smooth[i] = above[i] + 2 * here[i] + below[i];
  for (int i = 0; i < width; ++i) difference[i] = below[i] - above[i];
  reflect_ends(smooth, width);
  reflect_ends(difference, width);
  for (int i = 0; i < width; ++i) dx[i] = smooth[i + 1] - smooth[i - 1];
  for (int i = 0; i < width; ++i) dy[i] = difference[i - 1] + 2 * difference[i] + difference[i + 1];
}

WIDE void subtract(const int16_t* a, const int16_t* b, int width, int16_t* out) {
  for (int i = 0; i < width; ++i) out[i] = a[i] - b[i];
}

// prefer_stronger() on one row.
WIDE void prefer_stronger(int16_t* dx, int16_t* dy, const int16_t* hue_dx, const int16_t* hue_dy, int width,
                          double weight, int least) {
  for (int begin = 0; begin < width; begin += kBlock) {
    const int end = std::min(begin + kBlock, width);
    int16_t strongest = 0;
    for (int i = begin; i < end; ++i) {
      const int16_t across = hue_dx[i] < 0 ? -hue_dx[i] : hue_dx[i],
                    down = hue_dy[i] < 0 ? -hue_dy[i] : hue_dy[i];
      const int16_t strength = across + down;
      strongest = strength > strongest ? strength : strongest;
    }
    if (strongest <= least) continue;
    for (int i = begin; i < end; ++i) {
      const int strength = std::abs(hue_dx[i]) + std::abs(hue_dy[i]);
      if (strength > least && weight * strength > std::abs(dx[i]) + std::abs(dy[i])) {
        dx[i] = static_cast<int16_t>(std::nearbyint(weight * hue_dx[i]));
        dy[i] = static_cast<int16_t>(std::nearbyint(weight * hue_dy[i]));
      }
    }
  }
}

// Squared magnitudes of one row, and the largest of each block.
WIDE void square(const int16_t* dx, const int16_t* dy, int width, int32_t* out, int32_t* strongest) {
  for (int begin = 0; begin < width; begin += kBlock) {
    const int end = std::min(begin + kBlock, width);
    int32_t largest = 0;
    for (int i = begin; i < end; ++i) {
      out[i] = int32_t(dx[i]) * dx[i] + int32_t(dy[i]) * dy[i];
      largest = out[i] > largest ? out[i] : largest;
    }
    strongest[begin / kBlock] = largest;
  }
}

// Sobel responses of the frame into s.dx and dy, and of its hues into s.hue (dx, dy of yellow, of red).
void find_slopes(Scratch& s, const uint8_t* frame, int height, int width, bool coloured, int blur_px,
                 double weight, int least) {
  const size_t size = static_cast<size_t>(height) * width;
  const int channels = weight > 0.0 ? 3 : 1;
  s.dx.resize(size);
  s.dy.resize(size);
  s.smooth.resize(width + 2 * kPad);
  s.difference.resize(width + 2 * kPad);
  // Gray first, then blue and red.
  const uint8_t* images[3] = {frame};
  if (coloured) {
    for (auto& channel : s.channel) channel.resize(size);
    uint8_t *gray = s.channel[0].data(), *blue = s.channel[1].data(), *red = s.channel[2].data();
    split(frame, static_cast<int>(size), blue, gray, red);
    mix_gray(blue, gray, red, static_cast<int>(size));
    for (int k = 0; k < 3; ++k) images[k] = s.channel[k].data();
  }
  for (int k = 0; blur_px && k < channels; ++k) {
    s.blurred[k].resize(size);
    blur(s, images[k], height, width, blur_px, s.blurred[k].data());
    images[k] = s.blurred[k].data();
  }
  if (channels == 3) {
    for (auto& row : s.row) row.resize(width);
    for (auto& hue : s.hue) hue.resize(size);
  }
  for (int v = 0; v < height; ++v) {
    const size_t at = static_cast<size_t>(v) * width;
    const size_t above = static_cast<size_t>(reflect(v - 1, height)) * width;
    const size_t below = static_cast<size_t>(reflect(v + 1, height)) * width;
    int16_t *dx = s.dx.data() + at, *dy = s.dy.data() + at;
    for (int k = 0; k < channels; ++k) {
      const uint8_t* image = images[k];
      sobel_row(image + above, image + at, image + below, width, s.smooth.data() + kPad,
                s.difference.data() + kPad, k ? s.row[2 * k].data() : dx, k ? s.row[2 * k + 1].data() : dy);
    }
    if (channels == 1) continue;
    int16_t* hue[4];
    for (int i = 0; i < 4; ++i) hue[i] = s.hue[i].data() + at;
    subtract(dx, s.row[2].data(), width, hue[0]);
    subtract(dy, s.row[3].data(), width, hue[1]);
    subtract(s.row[4].data(), dx, width, hue[2]);
    subtract(s.row[5].data(), dy, width, hue[3]);
    prefer_stronger(dx, dy, hue[0], hue[1], width, weight, least);
    prefer_stronger(dx, dy, hue[2], hue[3], width, weight, least);
  }
}

// Median and 99th percentile of the Sobel magnitude at the sampled pixels.
void find_responses(Scratch& s, const int64_t* sample, size_t count, double* median, double* strong) {
  *median = *strong = 0.0;
  if (count == 0) return;
  // Bins by the upper bits of the float: few values share the one that holds a rank, and only they are put
  // in order.
  const auto bin_of = [](int32_t value) {
    const float number = static_cast<float>(value);
    uint32_t bits;
    std::memcpy(&bits, &number, sizeof bits);
    return bits >> 19;
  };
  s.sampled.resize(count);
  s.counts.assign(4096, 0);
  for (size_t i = 0; i < count; ++i) {
    const int32_t dx = s.dx[sample[i]], dy = s.dy[sample[i]];
    s.sampled[i] = dx * dx + dy * dy;
    ++s.counts[bin_of(s.sampled[i])];
  }
  const auto of_rank = [&](size_t rank) {
    uint32_t bin = 0;
    for (; rank >= s.counts[bin]; ++bin) rank -= s.counts[bin];
    s.ordered.clear();
    for (const int32_t value : s.sampled)
      if (bin_of(value) == bin) s.ordered.push_back(value);
    std::nth_element(s.ordered.begin(), s.ordered.begin() + rank, s.ordered.end());
    return std::sqrt(static_cast<double>(s.ordered[rank]));
  };
  *median = of_rank((count - 1) / 2);
  *strong = of_rank(static_cast<size_t>(0.99 * static_cast<double>(count - 1)));
}

inline int squared_threshold(double threshold) {
  threshold = std::min(32767.0, threshold);
  return static_cast<int>(std::floor(threshold > 0.0 ? threshold * threshold : threshold));
}

// OpenCV's Canny on s.dx and dy: the flat indices of its edges go to s.candidates, in rows.
void trace_edges(Scratch& s, int height, int width, double low_threshold, double high_threshold,
                 const uint8_t* keep) {
  if (low_threshold > high_threshold) std::swap(low_threshold, high_threshold);
  const int low = squared_threshold(low_threshold), high = squared_threshold(high_threshold);
  const int stride = width + 2;
  s.marks.assign(static_cast<size_t>(stride) * (height + 2), kNone);
  s.candidates.clear();
  s.stack.clear();
  for (int i = 0; i < 3; ++i) {
    s.magnitude[i].assign(stride, 0);
    s.strongest[i].resize(width / kBlock + 1);
  }
  square(s.dx.data(), s.dy.data(), width, s.magnitude[0].data() + 1, s.strongest[0].data());
  for (int v = 0; v < height; ++v) {
    const int32_t* above = s.magnitude[(v + 2) % 3].data() + 1;
    const int32_t* here = s.magnitude[v % 3].data() + 1;
    int32_t* below = s.magnitude[(v + 1) % 3].data() + 1;
    const size_t next = static_cast<size_t>(v + 1) * width;
    if (v + 1 < height)
      square(s.dx.data() + next, s.dy.data() + next, width, below, s.strongest[(v + 1) % 3].data());
    else std::fill_n(below, width, 0);
    for (int begin = 0; begin < width; begin += kBlock) {
      const int end = std::min(begin + kBlock, width);
      if (s.strongest[v % 3][begin / kBlock] <= low) continue;
      for (int u = begin; u < end; ++u) {
        const int32_t m = here[u];
        if (m <= low) continue;
        const int at = v * width + u, dx = s.dx[at], dy = s.dy[at];
        const int tan22 = std::abs(dx) * kTan22, y = std::abs(dy) << 15;
        bool peak;
        if (y < tan22) {
          peak = m > here[u - 1] && m >= here[u + 1];
        } else if (y > tan22 + (std::abs(dx) << 16)) {
          peak = m > above[u] && m >= below[u];
        } else {
          const int step = (dx ^ dy) < 0 ? -1 : 1;
          peak = m > above[u - step] && m > below[u + step];
        }
        if (!peak) continue;
        const int mark = (v + 1) * stride + u + 1;
        s.candidates.push_back(at);
        s.marks[mark] = m > high ? kEdge : kWeak;
        if (m > high) s.stack.push_back(mark);
      }
    }
  }
  const int beside[8] = {-stride - 1, -stride, -stride + 1, -1, 1, stride - 1, stride, stride + 1};
  while (!s.stack.empty()) {
    const int mark = s.stack.back();
    s.stack.pop_back();
    for (const int step : beside)
      if (s.marks[mark + step] == kWeak) {
        s.marks[mark + step] = kEdge;
        s.stack.push_back(mark + step);
      }
  }
  const auto dropped = [&](int at) {
    return s.marks[(at / width + 1) * stride + at % width + 1] != kEdge || (keep && !keep[at]);
  };
  s.candidates.erase(std::remove_if(s.candidates.begin(), s.candidates.end(), dropped), s.candidates.end());
}

inline double between(double x, double low, double high) { return std::min(std::max(x, low), high); }

// edge_pixels(): places, normals and shares of the hues, n x 2 each.
void measure_edges(const Scratch& s, int height, int width, bool subpixel, double* uv, double* normals,
                   double* shares) {
  for (size_t i = 0; i < s.candidates.size(); ++i) {
    const int at = s.candidates[i], v = at / width, u = at % width;
    const double dx = s.dx[at], dy = s.dy[at];
    const double strength = std::sqrt(dx * dx + dy * dy), scale = 1.0 / std::max(strength, 1e-9);
    const double nx = dx * scale, ny = dy * scale;
    double offset = 0.0;
    if (subpixel) {
      const int step_u = std::abs(nx) > kTan22Exact * std::abs(ny) ? (nx > 0.0) - (nx < 0.0) : 0;
      const int step_v = std::abs(ny) > kTan22Exact * std::abs(nx) ? (ny > 0.0) - (ny < 0.0) : 0;
      double along[2];
      for (int side = 0; side < 2; ++side) {
        const int sign = side ? 1 : -1;
        const int beside = std::clamp(v + sign * step_v, 0, height - 1) * width +
                           std::clamp(u + sign * step_u, 0, width - 1);
        along[side] = std::max(s.dx[beside] * nx + s.dy[beside] * ny, 0.0);
      }
      const double curvature = along[0] - 2.0 * strength + along[1];
      offset = curvature < 0.0 ? 0.5 * (along[0] - along[1]) / curvature : 0.0;
      offset = between(offset, -0.5, 0.5) * std::abs(step_u * nx + step_v * ny);
    }
    uv[2 * i] = u + offset * nx;
    uv[2 * i + 1] = v + offset * ny;
    normals[2 * i] = nx;
    normals[2 * i + 1] = ny;
    if (!shares) continue;
    const double unit = std::max(strength, 1.0);
    for (int k = 0; k < 2; ++k)
      shares[2 * i + k] = between((s.hue[2 * k][at] * nx + s.hue[2 * k + 1][at] * ny) / unit, -1.0, 1.0);
  }
}

// The nearest of n pixels; the first one for NaN, so that nothing outside the table is read.
inline double nearest(double place, int n) {
  const double pixel = std::nearbyint(place);
  return pixel > 0.0 ? std::min(pixel, n - 1.0) : 0.0;
}

// RoadTable.lift() of n edge points; those that are not finite in the result's type are left out if `finite`.
// Returns how many are left.
template <class T>
size_t lift_edges(size_t n, const double* uv, const double* normals, const double* hues, const double* table,
                  int height, int width, bool finite, T* out_points, T* out_normals, T* out_hues) {
  const auto row_of = [&](size_t i) {
    const double u = nearest(uv[2 * i], width), v = nearest(uv[2 * i + 1], height);
    return table + 6 * (static_cast<size_t>(v) * width + static_cast<size_t>(u));
  };
  size_t kept = 0;
  for (size_t i = 0; i < n; ++i) {
    // The table is larger than the caches: its rows are fetched a few points ahead.
    if (i + kAhead < n) PREFETCH(row_of(i + kAhead));
    const double u = nearest(uv[2 * i], width), v = nearest(uv[2 * i + 1], height);
    const double off_u = uv[2 * i] - u, off_v = uv[2 * i + 1] - v;
    const double* row = table + 6 * (static_cast<size_t>(v) * width + static_cast<size_t>(u));
    const double x_u = row[2], y_u = row[3], x_v = row[4], y_v = row[5];
    const double nu = normals[2 * i], nv = normals[2 * i + 1];
    const double turn = x_u * y_v - x_v * y_u;
    const double sign = turn > 0.0 ? 1.0 : turn < 0.0 ? -1.0 : turn == 0.0 ? 0.0 : turn;
    double nx = (y_v * nu - y_u * nv) * sign, ny = (x_u * nv - x_v * nu) * sign;
    const double length = std::sqrt(nx * nx + ny * ny), scale = 1.0 / (length < 1e-12 ? 1e-12 : length);
    const T x = static_cast<T>(row[0] + (x_u * off_u + x_v * off_v));
    const T y = static_cast<T>(row[1] + (y_u * off_u + y_v * off_v));
    const T across = static_cast<T>(nx * scale), ahead = static_cast<T>(ny * scale);
    if (finite && !std::isfinite(x + y + across + ahead)) continue;
    out_points[2 * kept] = x;
    out_points[2 * kept + 1] = y;
    out_normals[2 * kept] = across;
    out_normals[2 * kept + 1] = ahead;
    for (int k = 0; hues && k < 2; ++k) out_hues[2 * kept + k] = static_cast<T>(hues[2 * i + k]);
    ++kept;
  }
  return kept;
}

// fill_raster() of n points with one plane or five.
template <class T>
void mark_cells(size_t n, const T* points, const T* normals, const T* hues, T left_cm, T far_cm, T cell_cm,
                int rows, int columns, int planes, int middle, T steps, uint8_t* out) {
  const size_t size = static_cast<size_t>(rows) * columns;
  std::memset(out, 0, size);
  if (planes > 1) std::memset(out + size, middle, (planes - 1) * size);
  for (size_t i = 0; i < n; ++i) {
    const T x = (points[2 * i] - left_cm) / cell_cm, y = (far_cm - points[2 * i + 1]) / cell_cm;
    if (!(x >= 0 && x < columns && y >= 0 && y < rows)) continue;
    uint8_t* cell = out + static_cast<size_t>(y) * columns + static_cast<size_t>(x);
    *cell = 255;
    const T* looks[] = {normals + 2 * i, hues ? hues + 2 * i : nullptr};
    for (int plane = 1; plane < planes; ++plane)
      if (const T* look = looks[(plane - 1) / 2])
        cell[plane * size] = static_cast<uint8_t>(std::nearbyint(steps * look[(plane - 1) % 2]) + middle);
  }
}

// --- Python ---

// The memory of an argument; released at the end.
struct Buffer {
  Py_buffer view{};
  ~Buffer() { PyBuffer_Release(&view); }
  template <class T>
  T* as() const {
    return static_cast<T*>(view.buf);
  }
  bool holds(size_t bytes) const { return static_cast<size_t>(view.len) == bytes; }
};

PyObject* refuse(const char* what) {
  PyErr_SetString(PyExc_ValueError, what);
  return nullptr;
}

PyObject* find(PyObject*, PyObject* args) {
  Buffer frame, keep, sample;
  int height, width, blur_px, subpixel;
  double low, high, weight, share, dim, least_raised, clear;
  if (!PyArg_ParseTuple(args, "y*iiz*z*iddddp(ddd)", &frame.view, &height, &width, &keep.view, &sample.view,
                        &blur_px, &low, &high, &weight, &share, &subpixel, &dim, &least_raised, &clear))
    return nullptr;
  if (height < 3 || width < 3) return refuse("image: expected at least 3 x 3 pixels");
  const size_t size = static_cast<size_t>(height) * width;
  const bool coloured = frame.holds(3 * size);
  if (!coloured && !frame.holds(size)) return refuse("frame: not of this size");
  if (keep.view.buf && !keep.holds(size)) return refuse("keep: not of the frame's size");
  const size_t samples = sample.view.len / sizeof(int64_t);
  for (size_t i = 0; i < samples; ++i)
    if (static_cast<uint64_t>(sample.as<int64_t>()[i]) >= size) return refuse("sample: beyond the frame");
  try {
    static Scratch s;  // one caller at a time: the interpreter's lock is held
    if (!coloured) weight = 0.0;
    find_slopes(s, frame.as<uint8_t>(), height, width, coloured, blur_px, weight,
                weight > 0.0 ? static_cast<int>(std::min(low / weight, 254.0)) : 0);
    double raised = 1.0;
    if (share > 0.0) {
      double usual, strong;
      find_responses(s, sample.as<int64_t>(), samples, &usual, &strong);
      const double relative = share * (strong / high);
      raised =
          std::max(relative, std::min(1.0, std::max({dim * relative, least_raised, clear * (usual / high)})));
    }
    trace_edges(s, height, width, raised * low, raised * high, keep.as<uint8_t>());
    const size_t n = s.candidates.size(), blocks = weight > 0.0 ? 3 : 2;
    PyObject* result = PyByteArray_FromStringAndSize(nullptr, blocks * 2 * n * sizeof(double));
    if (!result) return nullptr;
    double* out = reinterpret_cast<double*>(PyByteArray_AsString(result));
    measure_edges(s, height, width, subpixel, out, out + 2 * n, blocks == 3 ? out + 4 * n : nullptr);
    return result;
  } catch (const std::exception&) {
    return PyErr_NoMemory();
  }
}

template <class T>
PyObject* lifted(size_t n, const Buffer& uv, const Buffer& normals, const Buffer& hues, const Buffer& table,
                 int height, int width, bool finite) {
  const size_t blocks = hues.view.buf ? 3 : 2;
  PyObject* result = PyByteArray_FromStringAndSize(nullptr, blocks * 2 * n * sizeof(T));
  if (!result) return nullptr;
  T* out = reinterpret_cast<T*>(PyByteArray_AsString(result));
  const size_t kept = lift_edges(n, uv.as<double>(), normals.as<double>(), hues.as<double>(),
                                 table.as<double>(), height, width, finite, out, out + 2 * n, out + 4 * n);
  if (kept == n) return result;
  for (size_t block = 1; block < blocks; ++block)
    std::memmove(out + 2 * block * kept, out + 2 * block * n, 2 * kept * sizeof(T));
  if (PyByteArray_Resize(result, blocks * 2 * kept * sizeof(T)) == 0) return result;
  Py_DECREF(result);
  return nullptr;
}

PyObject* lift(PyObject*, PyObject* args) {
  Buffer uv, normals, hues, table;
  int height, width, single;
  if (!PyArg_ParseTuple(args, "y*y*z*y*iip", &uv.view, &normals.view, &hues.view, &table.view, &height,
                        &width, &single))
    return nullptr;
  const size_t n = uv.view.len / (2 * sizeof(double));
  if (!normals.holds(uv.view.len) || (hues.view.buf && !hues.holds(uv.view.len)))
    return refuse("edges: positions, normals and hues differ in number");
  if (height < 1 || width < 1 || !table.holds(6 * sizeof(double) * height * width))
    return refuse("table: not of this size");
  return single ? lifted<float>(n, uv, normals, hues, table, height, width, true)
                : lifted<double>(n, uv, normals, hues, table, height, width, false);
}

PyObject* raster(PyObject*, PyObject* args) {
  Buffer points, normals, hues, out;
  double left_cm, far_cm, cell_cm, steps;
  int rows, columns, planes, middle, single;
  if (!PyArg_ParseTuple(args, "y*y*z*w*dddiiiidp", &points.view, &normals.view, &hues.view, &out.view,
                        &left_cm, &far_cm, &cell_cm, &rows, &columns, &planes, &middle, &steps, &single))
    return nullptr;
  if (!normals.holds(points.view.len) || (hues.view.buf && !hues.holds(points.view.len)))
    return refuse("edges: points, normals and hues differ in number");
  if (rows < 1 || columns < 1 || planes < 1 || planes > 5 ||
      !out.holds(static_cast<size_t>(planes) * rows * columns))
    return refuse("raster: not of this size");
  const auto fill = [&](auto type) {
    using T = decltype(type);
    mark_cells<T>(points.view.len / (2 * sizeof(T)), points.as<T>(), normals.as<T>(), hues.as<T>(),
                  T(left_cm), T(far_cm), T(cell_cm), rows, columns, planes, middle, T(steps),
                  out.as<uint8_t>());
  };
  if (single) fill(float{});
  else fill(double{});
  Py_RETURN_NONE;
}

PyMethodDef methods[] = {
    {"find", find, METH_VARARGS, nullptr},
    {"lift", lift, METH_VARARGS, nullptr},
    {"raster", raster, METH_VARARGS, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_kernels", nullptr, 0, methods, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__kernels() { return PyModuleDef_Init(&module); }
