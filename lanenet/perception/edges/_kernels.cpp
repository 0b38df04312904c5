// Edge points, their places on the road, and the raster: canny.py, pixels.py, road.py and raster.py,
// compiled. What a step means and where it comes from stands there. Every number is rounded as NumPy and
// OpenCV round it, so that the bytes are equal: integers up to the edges, then double precision in the order
// of the Python code (build with -ffp-contract=off). Arrays come as contiguous buffers, whose types
// compiled.py sees to.

#include "../arguments.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <vector>

// On x86-64 the loops over pixels exist twice, and the processor chooses.
#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#define SHUFFLES
#else
#define WIDE
#endif
// Part of its caller, for whichever processor that is compiled.
#if defined(__GNUC__)
#define WITHIN inline __attribute__((always_inline))
#define PREFETCH(address) __builtin_prefetch(address)
#else
#define WITHIN inline
#define PREFETCH(address) (void)(address)
#endif
#define APART __restrict

namespace {

using std::int16_t;
using std::int32_t;
using std::uint16_t;
using std::uint32_t;
using std::uint64_t;
using std::uint8_t;

constexpr int kPad = 2;        // pixels that a filter looks at beside a row
constexpr int kRing = 8;       // rows of the frame that are kept for the blur, which looks at 5
constexpr int kBlock = 16;     // pixels that are skipped together where nothing is strong
constexpr int kChunk = 64;     // edge points that are measured together
constexpr int kTan22 = 13573;  // tan(22.5 degrees) in 15 bits, OpenCV's
constexpr double kTan22Exact = 0.41421356237309503;  // numpy.tan(pi / 8)
enum : uint8_t { kNone, kWeak, kEdge };              // marks of the hysteresis

// Memory that is kept from frame to frame. Of the channels gray is the first, then blue and red.
struct Scratch {
  std::vector<uint8_t> ring[3], blurred[3], over, marks;
  std::vector<uint16_t> column_sum;
  std::vector<int16_t> sum, difference, hue[2], hue_dx, hue_dy, dx, dy;
  std::vector<int32_t> magnitude, candidates, stack, sampled, ordered;
  std::vector<uint32_t> counts;
  const uint8_t* images[3];
  int channels;
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

// Whether one of kBlock bytes is not 0.
inline bool any_of(const uint8_t* block) {
  uint64_t words[kBlock / 8];
  std::memcpy(words, block, kBlock);
  return words[0] | words[1];
}

#ifdef SHUFFLES
// The compiler finds no way of its own to take every third byte.
using Bytes = uint8_t __attribute__((vector_size(16)));

WITHIN int split_blocks(const uint8_t* bgr, int count, uint8_t* blue, uint8_t* green, uint8_t* red) {
  int i = 0;
  for (; i + 16 <= count; i += 16) {
    Bytes a, b, c;
    std::memcpy(&a, bgr + 3 * i, 16);
    std::memcpy(&b, bgr + 3 * i + 16, 16);
    std::memcpy(&c, bgr + 3 * i + 32, 16);
    const Bytes ab_blue = __builtin_shuffle(a, b, Bytes{0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30});
    const Bytes ab_green = __builtin_shuffle(a, b, Bytes{1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31});
    const Bytes ab_red = __builtin_shuffle(a, b, Bytes{2, 5, 8, 11, 14, 17, 20, 23, 26, 29});
    const Bytes all_blue =
        __builtin_shuffle(ab_blue, c, Bytes{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29});
    const Bytes all_green =
        __builtin_shuffle(ab_green, c, Bytes{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30});
    const Bytes all_red =
        __builtin_shuffle(ab_red, c, Bytes{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31});
    std::memcpy(blue + i, &all_blue, 16);
    std::memcpy(green + i, &all_green, 16);
    std::memcpy(red + i, &all_red, 16);
  }
  return i;
}
#else
WITHIN int split_blocks(const uint8_t*, int, uint8_t*, uint8_t*, uint8_t*) { return 0; }
#endif

// One row of the frame in its channels; gray is OpenCV's.
WIDE void split_row(const uint8_t* APART bgr, int width, uint8_t* APART gray, uint8_t* APART blue,
                    uint8_t* APART red) {
  for (int i = split_blocks(bgr, width, blue, gray, red); i < width; ++i) {
    blue[i] = bgr[3 * i];
    gray[i] = bgr[3 * i + 1];
    red[i] = bgr[3 * i + 2];
  }
  for (int i = 0; i < width; ++i)
    gray[i] = static_cast<uint8_t>((3735 * blue[i] + 19235 * gray[i] + 9798 * red[i] + 16384) >> 15);
}

// One row of the Gauss blur of 3 px (1 2 1) or 5 px (1 4 6 4 1) in both directions; rows from top to bottom.
WIDE void blur_row(const uint8_t* const rows[5], int size, int width, uint16_t* APART sums,
                   uint8_t* APART out) {
  const uint8_t *a = rows[0], *b = rows[1], *c = rows[2], *d = rows[3], *e = rows[4];
  if (size == 3) {
    for (int i = 0; i < width; ++i) sums[i] = b[i] + 2 * c[i] + d[i];
    reflect_ends(sums, width);
    for (int i = 0; i < width; ++i)
      out[i] = static_cast<uint8_t>(static_cast<uint16_t>(sums[i - 1] + 2 * sums[i] + sums[i + 1] + 8) >> 4);
  } else {
    for (int i = 0; i < width; ++i) sums[i] = a[i] + 4 * (b[i] + d[i]) + 6 * c[i] + e[i];
    reflect_ends(sums, width);
    for (int i = 0; i < width; ++i)
      out[i] = static_cast<uint8_t>(static_cast<uint16_t>(sums[i - 2] + 4 * (sums[i - 1] + sums[i + 1]) +
                                                          6 * sums[i] + sums[i + 2] + 128) >>
                                    8);
  }
}

// The Sobel responses of one row; `image` is its first pixel, the others are so far from there.
WIDE void sobel_row(const uint8_t* image, std::ptrdiff_t above, std::ptrdiff_t below, int width,
                    int16_t* APART sum, int16_t* APART difference, int16_t* APART dx, int16_t* APART dy) {
  for (int i = 0; i < width; ++i) sum[i] = image[i + above] + 2 * image[i] + image[i + below];
  for (int i = 0; i < width; ++i) difference[i] = image[i + below] - image[i + above];
  reflect_ends(sum, width);
  reflect_ends(difference, width);
  for (int i = 0; i < width; ++i) {
    dx[i] = sum[i + 1] - sum[i - 1];
    dy[i] = difference[i - 1] + 2 * difference[i] + difference[i + 1];
  }
}

// Those of a hue, and where both together are above `least`; returns whether that is anywhere.
WIDE bool sobel_row_of_hue(const int16_t* image, const int16_t* above, const int16_t* below, int width, int least,
                           int16_t* APART sum, int16_t* APART difference, int16_t* APART dx, int16_t* APART dy,
                           uint8_t* APART over) {
  for (int i = 0; i < width; ++i) {
    sum[i] = above[i] + 2 * image[i] + below[i];
    difference[i] = below[i] - above[i];
  }
  reflect_ends(sum, width);
  reflect_ends(difference, width);
  const int16_t limit = static_cast<int16_t>(least);
  uint8_t any = 0;
  for (int i = 0; i < width; ++i) {
    const int16_t x = sum[i + 1] - sum[i - 1];
    const int16_t y = difference[i - 1] + 2 * difference[i] + difference[i + 1];
    const int16_t across = x < 0 ? -x : x, down = y < 0 ? -y : y, strength = across + down;
    dx[i] = x;
    dy[i] = y;
    over[i] = strength > limit ? 255 : 0;
    any |= over[i];
  }
  return any;
}

// Yellow and red of one row: gray minus blue, and red minus gray.
WIDE void find_hues(const uint8_t* APART gray, const uint8_t* APART blue, const uint8_t* APART red, int width,
                    int16_t* APART yellow, int16_t* APART out_red) {
  for (int i = 0; i < width; ++i) {
    yellow[i] = gray[i] - blue[i];
    out_red[i] = red[i] - gray[i];
  }
}

// prefer_stronger() on one row, where a pixel is marked.
void prefer_stronger(int16_t* dx, int16_t* dy, const int16_t* hue_dx, const int16_t* hue_dy,
                     const uint8_t* over, int width, double weight) {
  for (int begin = 0; begin < width; begin += kBlock) {
    if (!any_of(over + begin)) continue;
    const int end = std::min(begin + kBlock, width);
    for (int i = begin; i < end; ++i) {
      const int strength = std::abs(hue_dx[i]) + std::abs(hue_dy[i]);
      if (over[i] && weight * strength > std::abs(dx[i]) + std::abs(dy[i])) {
        dx[i] = static_cast<int16_t>(std::lrint(weight * hue_dx[i]));
        dy[i] = static_cast<int16_t>(std::lrint(weight * hue_dy[i]));
      }
    }
  }
}

WIDE void square_row(const int16_t* APART dx, const int16_t* APART dy, int width, int32_t* APART out) {
  for (int i = 0; i < width; ++i) out[i] = int32_t(dx[i]) * dx[i] + int32_t(dy[i]) * dy[i];
}

// The channels of the frame into s.images, row by row, so that each is still at hand for the next filter.
class Channels {
 public:
  Channels(Scratch& s, const uint8_t* frame, int height, int width, bool coloured, int blur_px)
      : s_(s), frame_(frame), height_(height), width_(width), coloured_(coloured), blur_px_(blur_px) {
    s.column_sum.resize(width + 2 * kPad);
    for (int k = 0; k < 3; ++k) {
      if (coloured) s.ring[k].resize(static_cast<size_t>(kRing) * width);
      if (coloured || blur_px) s.blurred[k].resize(static_cast<size_t>(height) * width);
      s.images[k] = coloured || blur_px ? s.blurred[k].data() : frame;
    }
  }

  int16_t* hue(int k, int row) { return s_.hue[k].data() + static_cast<size_t>(row % kRing) * width_; }

  // Go on until a row of the images is done.
  void reach(int row) {
    for (row = std::min(row, height_ - 1); done_ <= row; ++done_) {
      for (const int last = std::min(done_ + (blur_px_ ? 2 : 0), height_ - 1); split_ <= last; ++split_)
        if (coloured_)
          split_row(frame_ + 3 * static_cast<size_t>(split_) * width_, width_, source(0, split_),
                    source(1, split_), source(2, split_));
      const size_t at = static_cast<size_t>(done_) * width_;
      for (int k = 0; blur_px_ && k < s_.channels; ++k) {
        const uint8_t* rows[5];
        for (int i = 0; i < 5; ++i) rows[i] = row_of(k, reflect(done_ + i - 2, height_));
        blur_row(rows, blur_px_, width_, s_.column_sum.data() + kPad, s_.blurred[k].data() + at);
      }
      if (s_.channels == 3)
        find_hues(s_.images[0] + at, s_.images[1] + at, s_.images[2] + at, width_, hue(0, done_), hue(1, done_));
    }
  }

 private:
  uint8_t* source(int k, int row) {
    return blur_px_ ? s_.ring[k].data() + static_cast<size_t>(row % kRing) * width_
                    : s_.blurred[k].data() + static_cast<size_t>(row) * width_;
  }
  const uint8_t* row_of(int k, int row) {
    return coloured_ ? source(k, row) : frame_ + static_cast<size_t>(row) * width_;
  }

  Scratch& s_;
  const uint8_t* frame_;
  int height_, width_;
  bool coloured_;
  int blur_px_, done_ = 0, split_ = 0;
};

// Sobel responses of the frame into s.dx and dy, their squared lengths into s.magnitude, which has one pixel more
// on each side.
void find_slopes(Scratch& s, const uint8_t* frame, int height, int width, bool coloured, int blur_px,
                 double weight, int least) {
  const size_t size = static_cast<size_t>(height) * width, stride = width + 2;
  s.channels = weight > 0.0 ? 3 : 1;
  s.dx.resize(size + kBlock);
  s.dy.resize(size + kBlock);
  s.magnitude.resize((height + 2) * stride + kBlock);
  s.sum.resize(width + 2 * kPad);
  s.difference.resize(width + 2 * kPad);
  for (auto& rows : s.hue) rows.resize(static_cast<size_t>(kRing) * width);
  s.hue_dx.resize(width);
  s.hue_dy.resize(width);
  s.over.assign(width + kBlock, 0);
  int16_t *sum = s.sum.data() + kPad, *difference = s.difference.data() + kPad;
  std::fill_n(s.magnitude.data(), stride + 1, 0);
  Channels channels(s, frame, height, width, coloured, blur_px);
  for (int v = 0; v < height; ++v) {
    channels.reach(v + 1);
    const size_t at = static_cast<size_t>(v) * width;
    const int up = reflect(v - 1, height), down = reflect(v + 1, height);
    const std::ptrdiff_t above = std::ptrdiff_t(up - v) * width, below = std::ptrdiff_t(down - v) * width;
    int16_t *dx = s.dx.data() + at, *dy = s.dy.data() + at, *hue_dx = s.hue_dx.data(), *hue_dy = s.hue_dy.data();
    sobel_row(s.images[0] + at, above, below, width, sum, difference, dx, dy);
    for (int k = 0; k < s.channels - 1; ++k)
      if (sobel_row_of_hue(channels.hue(k, v), channels.hue(k, up), channels.hue(k, down), width, least, sum,
                           difference, hue_dx, hue_dy, s.over.data()))
        prefer_stronger(dx, dy, hue_dx, hue_dy, s.over.data(), width, weight);
    int32_t* magnitude = s.magnitude.data() + (v + 1) * stride + 1;
    square_row(dx, dy, width, magnitude);
    magnitude[width] = magnitude[width + 1] = 0;
  }
  std::fill_n(s.magnitude.data() + (height + 1) * stride, stride, 0);
}

// Median and 99th percentile of the Sobel magnitude at the sampled pixels.
void find_responses(Scratch& s, const int64_t* sample, size_t count, int width, double* median, double* strong) {
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
  // Neighbours mostly share a bin: counted apart, they do not wait for each other.
  s.counts.assign(2 * 4096, 0);
  uint32_t *even = s.counts.data(), *odd = even + 4096;
  int64_t v = 0, begin = 0;
  for (size_t i = 0; i < count; ++i) {
    // Samples come in rows.
    if (sample[i] < begin || sample[i] >= begin + width) v = sample[i] / width, begin = v * width;
    s.sampled[i] = s.magnitude[(v + 1) * (width + 2) + 1 + (sample[i] - begin)];
    ++(i % 2 ? odd : even)[bin_of(s.sampled[i])];
  }
  for (int bin = 0; bin < 4096; ++bin) even[bin] += odd[bin];
  const auto least_of = [](uint32_t bin) {
    float number;
    bin <<= 19;
    std::memcpy(&number, &bin, sizeof number);
    return static_cast<uint32_t>(std::ceil(number));
  };
  const auto of_rank = [&](size_t rank) {
    uint32_t bin = 0;
    for (; rank >= s.counts[bin]; ++bin) rank -= s.counts[bin];
    const uint32_t least = least_of(bin), span = least_of(bin + 1) - least;
    s.ordered.resize(s.counts[bin] + 1);
    int32_t* out = s.ordered.data();
    for (const int32_t value : s.sampled) {
      *out = value;
      out += static_cast<uint32_t>(value) - least < span;
    }
    std::nth_element(s.ordered.begin(), s.ordered.begin() + rank, s.ordered.end() - 1);
    return std::sqrt(static_cast<double>(s.ordered[rank]));
  };
  *median = of_rank((count - 1) / 2);
  *strong = of_rank(static_cast<size_t>(0.99 * static_cast<double>(count - 1)));
}

inline int squared_threshold(double threshold) {
  threshold = std::min(32767.0, threshold);
  return static_cast<int>(std::floor(threshold > 0.0 ? threshold * threshold : threshold));
}

WITHIN int32_t choose(int32_t mask, int32_t a, int32_t b) { return b ^ ((a ^ b) & mask); }

// Mark the pixels of a row that are above a threshold and no weaker than their neighbours along the gradient, in
// each block with such a pixel; `over` tells which blocks those are. Writes up to the end of the last block.
WIDE void mark_peaks(const int32_t* APART here, int stride, const int16_t* APART dx, const int16_t* APART dy,
                     int width, int low, int high, uint8_t* APART over, uint8_t* APART marks) {
  for (int i = 0; i < width; ++i) over[i] = here[i] > low ? 255 : 0;
  const int32_t *above = here - stride, *below = here + stride;
  for (int begin = 0; begin < width; begin += kBlock) {
    if (!any_of(over + begin)) continue;
    for (int i = begin; i < begin + kBlock; ++i) {
      const int32_t m = here[i], x = dx[i], y = dy[i];
      const int32_t left = here[i - 1], right = here[i + 1], up = above[i], down = below[i];
      const int32_t up_left = above[i - 1], up_right = above[i + 1];
      const int32_t down_left = below[i - 1], down_right = below[i + 1];
      const int32_t across = x < 0 ? -x : x, tall = (y < 0 ? -y : y) << 15, tan22 = across * kTan22;
      // All bits are set where it is so: with branches the loop would not be done in vectors.
      const int32_t flat = -(tall < tan22), steep = -(tall > tan22 + (across << 16)), falling = (x ^ y) >> 31;
      const int32_t before = choose(flat, left, choose(steep, up, choose(falling, up_right, up_left)));
      const int32_t after = choose(flat, right, choose(steep, down, choose(falling, down_left, down_right)));
      // Only beside and below may the other one be as strong.
      const int32_t peak = -(m > low) & -(m > before) & -(m - (flat | steep) > after);
      marks[i] = static_cast<uint8_t>(peak & (kWeak + (m > high)));
    }
  }
}

// OpenCV's Canny on s.dx and dy: the flat indices of its edges go to s.candidates, in rows.
void trace_edges(Scratch& s, int height, int width, double low_threshold, double high_threshold,
                 const uint8_t* keep) {
  const int low = squared_threshold(low_threshold), high = squared_threshold(high_threshold);
  const int stride = width + 2;
  s.marks.assign(static_cast<size_t>(stride) * (height + 2) + kBlock, kNone);
  s.candidates.clear();
  s.stack.clear();
  for (int v = 0; v < height; ++v) {
    const size_t at = static_cast<size_t>(v) * width;
    const int mark = (v + 1) * stride + 1;
    uint8_t* marks = s.marks.data() + mark;
    mark_peaks(s.magnitude.data() + mark, stride, s.dx.data() + at, s.dy.data() + at, width, low, high,
               s.over.data(), marks);
    std::memset(marks + width, kNone, kBlock);
    for (int begin = 0; begin < width; begin += kBlock) {
      if (!any_of(marks + begin)) continue;
      for (int u = begin; u < begin + kBlock; ++u)
        if (marks[u] != kNone) {
          s.candidates.push_back(mark + u);
          if (marks[u] == kEdge) s.stack.push_back(mark + u);
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
  size_t kept = 0;
  int v = 0;
  for (const int mark : s.candidates) {
    if (s.marks[mark] != kEdge) continue;
    while (mark >= (v + 2) * stride) ++v;
    const int at = mark - stride - 1 - 2 * v;
    if (!keep || keep[at]) s.candidates[kept++] = at;
  }
  s.candidates.resize(kept);
}

WITHIN double between(double x, double low, double high) {
  x = x < low ? low : x;
  return high < x ? high : x;
}

// Some edge points: pixels, gradients, and what becomes of them.
struct Chunk {
  double u[kChunk], v[kChunk], dx[kChunk], dy[kChunk], normal_u[kChunk], normal_v[kChunk], strength[kChunk];
  double step_u[kChunk], step_v[kChunk], side_dx[2][kChunk], side_dy[2][kChunk];
  double hue_dx[2][kChunk], hue_dy[2][kChunk], share[2][kChunk];
  double nearest_u[kChunk], nearest_v[kChunk], row[6][kChunk];
  double x[kChunk], y[kChunk], normal_x[kChunk], normal_y[kChunk];
  int n;
};

WIDE void find_normals(Chunk& c) {
  for (int i = 0; i < c.n; ++i) {
    const double dx = c.dx[i], dy = c.dy[i], strength = std::sqrt(dx * dx + dy * dy);
    const double scale = 1.0 / (strength < 1e-9 ? 1e-9 : strength), nu = dx * scale, nv = dy * scale;
    c.strength[i] = strength;
    c.normal_u[i] = nu;
    c.normal_v[i] = nv;
    const double sign_u = nu > 0.0 ? 1.0 : nu < 0.0 ? -1.0 : 0.0, sign_v = nv > 0.0 ? 1.0 : nv < 0.0 ? -1.0 : 0.0;
    c.step_u[i] = std::abs(nu) > kTan22Exact * std::abs(nv) ? sign_u : 0.0;
    c.step_v[i] = std::abs(nv) > kTan22Exact * std::abs(nu) ? sign_v : 0.0;
  }
}

WIDE void move_to_peaks(Chunk& c) {
  for (int i = 0; i < c.n; ++i) {
    const double nu = c.normal_u[i], nv = c.normal_v[i];
    double before = c.side_dx[0][i] * nu + c.side_dy[0][i] * nv, after = c.side_dx[1][i] * nu + c.side_dy[1][i] * nv;
    before = before < 0.0 ? 0.0 : before;
    after = after < 0.0 ? 0.0 : after;
    const double curvature = before - 2.0 * c.strength[i] + after;
    const double peak = 0.5 * (before - after) / (curvature < 0.0 ? curvature : -1.0);
    const double offset = between(curvature < 0.0 ? peak : 0.0, -0.5, 0.5) *
                          std::abs(c.step_u[i] * nu + c.step_v[i] * nv);
    c.u[i] += offset * nu;
    c.v[i] += offset * nv;
  }
}

WIDE void share_hues(Chunk& c) {
  for (int k = 0; k < 2; ++k)
    for (int i = 0; i < c.n; ++i) {
      const double unit = c.strength[i] < 1.0 ? 1.0 : c.strength[i];
      c.share[k][i] =
          between((c.hue_dx[k][i] * c.normal_u[i] + c.hue_dy[k][i] * c.normal_v[i]) / unit, -1.0, 1.0);
    }
}

// edge_pixels() of some of s.candidates: places, normals and shares of the hues.
void measure_edges(const Scratch& s, int height, int width, bool subpixel, size_t begin, size_t end, Chunk& c) {
  c.n = static_cast<int>(end - begin);
  int v = s.candidates[begin] / width;
  for (int i = 0; i < c.n; ++i) {
    const int at = s.candidates[begin + i];
    while (at >= (v + 1) * width) ++v;
    c.u[i] = at - v * width;
    c.v[i] = v;
    c.dx[i] = s.dx[at];
    c.dy[i] = s.dy[at];
  }
  find_normals(c);
  for (int i = 0; subpixel && i < c.n; ++i) {
    const int u = static_cast<int>(c.u[i]), v = static_cast<int>(c.v[i]);
    const int step_u = static_cast<int>(c.step_u[i]), step_v = static_cast<int>(c.step_v[i]);
    for (int side = 0; side < 2; ++side) {
      const int sign = side ? 1 : -1;
      const int beside =
          std::clamp(v + sign * step_v, 0, height - 1) * width + std::clamp(u + sign * step_u, 0, width - 1);
      c.side_dx[side][i] = s.dx[beside];
      c.side_dy[side][i] = s.dy[beside];
    }
  }
  for (int i = 0; s.channels == 3 && i < c.n; ++i) {
    const int u = static_cast<int>(c.u[i]), v = static_cast<int>(c.v[i]);
    const int left = reflect(u - 1, width), right = reflect(u + 1, width);
    const int rows[3] = {reflect(v - 1, height) * width, v * width, reflect(v + 1, height) * width};
    int dx[3], dy[3];
    for (int k = 0; k < 3; ++k) {
      const uint8_t *a = s.images[k] + rows[0], *b = s.images[k] + rows[1], *d = s.images[k] + rows[2];
      dx[k] = (a[right] + 2 * b[right] + d[right]) - (a[left] + 2 * b[left] + d[left]);
      dy[k] = (d[left] + 2 * d[u] + d[right]) - (a[left] + 2 * a[u] + a[right]);
    }
    c.hue_dx[0][i] = dx[0] - dx[1];
    c.hue_dy[0][i] = dy[0] - dy[1];
    c.hue_dx[1][i] = dx[2] - dx[0];
    c.hue_dy[1][i] = dy[2] - dy[0];
  }
  if (subpixel) move_to_peaks(c);
  if (s.channels == 3) share_hues(c);
}

// The pixel of each point; the first one for NaN, so that nothing outside the table is read.
WIDE void find_nearest(Chunk& c, int height, int width) {
  for (int i = 0; i < c.n; ++i) {
    const double u = std::nearbyint(c.u[i]), v = std::nearbyint(c.v[i]);
    c.nearest_u[i] = u > 0.0 ? (u < width - 1.0 ? u : width - 1.0) : 0.0;
    c.nearest_v[i] = v > 0.0 ? (v < height - 1.0 ? v : height - 1.0) : 0.0;
  }
}

WIDE void move_to_road(Chunk& c) {
  for (int i = 0; i < c.n; ++i) {
    const double off_u = c.u[i] - c.nearest_u[i], off_v = c.v[i] - c.nearest_v[i];
    const double x_u = c.row[2][i], y_u = c.row[3][i], x_v = c.row[4][i], y_v = c.row[5][i];
    const double nu = c.normal_u[i], nv = c.normal_v[i];
    const double turn = x_u * y_v - x_v * y_u;
    const double sign = turn > 0.0 ? 1.0 : turn < 0.0 ? -1.0 : turn == 0.0 ? 0.0 : turn;
    const double nx = (y_v * nu - y_u * nv) * sign, ny = (x_u * nv - x_v * nu) * sign;
    const double length = std::sqrt(nx * nx + ny * ny), scale = 1.0 / (length < 1e-12 ? 1e-12 : length);
    c.x[i] = c.row[0][i] + (x_u * off_u + x_v * off_v);
    c.y[i] = c.row[1][i] + (y_u * off_u + y_v * off_v);
    c.normal_x[i] = nx * scale;
    c.normal_y[i] = ny * scale;
  }
}

// RoadTable.lift() of some edge points.
void lift_edges(Chunk& c, const double* table, int height, int width) {
  find_nearest(c, height, width);
  const double* rows[kChunk];
  for (int i = 0; i < c.n; ++i) {
    rows[i] = table + 6 * (static_cast<size_t>(c.nearest_v[i]) * width + static_cast<size_t>(c.nearest_u[i]));
    // The table is larger than the caches; a row may lie in two of their lines.
    PREFETCH(rows[i]);
    PREFETCH(rows[i] + 5);
  }
  for (int i = 0; i < c.n; ++i)
    for (int k = 0; k < 6; ++k) c.row[k][i] = rows[i][k];
  move_to_road(c);
}

// Points, normals and hues of a result, n x 2 each; hues may be none.
template <class T>
struct Out {
  T *points, *normals, *hues;

  Out(void* memory, size_t n, bool coloured)
      : points(static_cast<T*>(memory)), normals(points + 2 * n), hues(coloured ? points + 4 * n : nullptr) {}
};

// Add lifted points to a result that has `kept`; those that are not finite in its type are left out if `finite`.
template <class T>
size_t add_lifted(const Chunk& c, bool finite, Out<T>& out, size_t kept) {
  for (int i = 0; i < c.n; ++i) {
    const T x = static_cast<T>(c.x[i]), y = static_cast<T>(c.y[i]);
    const T across = static_cast<T>(c.normal_x[i]), ahead = static_cast<T>(c.normal_y[i]);
    if (finite && !std::isfinite(x + y + across + ahead)) continue;
    out.points[2 * kept] = x;
    out.points[2 * kept + 1] = y;
    out.normals[2 * kept] = across;
    out.normals[2 * kept + 1] = ahead;
    for (int k = 0; out.hues && k < 2; ++k) out.hues[2 * kept + k] = static_cast<T>(c.share[k][i]);
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
        cell[plane * size] = static_cast<uint8_t>(std::lrint(steps * look[(plane - 1) % 2]) + middle);
  }
}

// --- Python ---

// What is found in a frame: its edge points are in s.candidates.
struct Search {
  Buffer frame, keep, sample;
  int height, width, blur_px, subpixel;
  double low, high, weight, share, dim, least_raised, clear;

  // Returns what is wrong with the arguments, or nothing.
  const char* fault() const {
    if (height < 3 || width < 3) return "image: expected at least 3 x 3 pixels";
    const size_t size = static_cast<size_t>(height) * width;
    if (!frame.holds<uint8_t>(3 * size) && !frame.holds<uint8_t>(size)) return "frame: not of this size";
    if (keep.view.buf && !keep.holds<uint8_t>(size)) return "keep: not of the frame's size";
    const int64_t* at = sample.as<int64_t>();
    bool beyond = false;
    for (Py_ssize_t i = 0; i < sample.size<int64_t>(); ++i) beyond |= static_cast<uint64_t>(at[i]) >= size;
    return beyond ? "sample: beyond the frame" : nullptr;
  }

  void run(Scratch& s) {
    const bool coloured = frame.holds<uint8_t>(3 * static_cast<size_t>(height) * width);
    if (!coloured) weight = 0.0;
    find_slopes(s, frame.as<uint8_t>(), height, width, coloured, blur_px, weight,
                weight > 0.0 ? static_cast<int>(std::min(low / weight, 254.0)) : 0);
    double raised = 1.0;
    if (share > 0.0) {
      double usual, strong;
      find_responses(s, sample.as<int64_t>(), sample.size<int64_t>(), width, &usual, &strong);
      const double relative = share * (strong / high);
      raised =
          std::max(relative, std::min(1.0, std::max({dim * relative, least_raised, clear * (usual / high)})));
    }
    trace_edges(s, height, width, raised * low, raised * high, keep.as<uint8_t>());
  }
};

Scratch& scratch() {
  static Scratch s;  // one caller at a time: the interpreter's lock is held
  return s;
}

PyObject* find(PyObject*, PyObject* args) {
  Search search;
  if (!PyArg_ParseTuple(args, "y*iiz*z*iddddp(ddd)", &search.frame.view, &search.height, &search.width,
                        &search.keep.view, &search.sample.view, &search.blur_px, &search.low, &search.high,
                        &search.weight, &search.share, &search.subpixel, &search.dim, &search.least_raised,
                        &search.clear))
    return nullptr;
  if (const char* fault = search.fault()) return refuse(fault);
  try {
    Scratch& s = scratch();
    search.run(s);
    const size_t n = s.candidates.size();
    const bool coloured = s.channels == 3;
    PyObject* result = PyByteArray_FromStringAndSize(nullptr, (coloured ? 6 : 4) * n * sizeof(double));
    if (!result) return nullptr;
    Out<double> out(PyByteArray_AsString(result), n, coloured);
    Chunk c;
    for (size_t begin = 0; begin < n; begin += kChunk) {
      measure_edges(s, search.height, search.width, search.subpixel, begin, std::min(begin + kChunk, n), c);
      for (int i = 0; i < c.n; ++i) {
        const size_t at = 2 * (begin + i);
        out.points[at] = c.u[i];
        out.points[at + 1] = c.v[i];
        out.normals[at] = c.normal_u[i];
        out.normals[at + 1] = c.normal_v[i];
        for (int k = 0; coloured && k < 2; ++k) out.hues[at + k] = c.share[k][i];
      }
    }
    return result;
  } catch (const std::exception&) {
    return PyErr_NoMemory();
  }
}

// Close the gaps between the blocks of a result that was made for n points and has fewer.
template <class T>
PyObject* shortened(PyObject* result, size_t n, size_t kept, size_t blocks) {
  T* out = reinterpret_cast<T*>(PyByteArray_AsString(result));
  if (kept == n) return result;
  for (size_t block = 1; block < blocks; ++block)
    std::memmove(out + 2 * block * kept, out + 2 * block * n, 2 * kept * sizeof(T));
  if (PyByteArray_Resize(result, blocks * 2 * kept * sizeof(T)) == 0) return result;
  Py_DECREF(result);
  return nullptr;
}

// find() and lift() in single precision, of a part of the frame that begins at a row.
PyObject* extract(PyObject*, PyObject* args) {
  Search search;
  Buffer table;
  int first, rows;
  if (!PyArg_ParseTuple(args, "y*iiz*z*iddddp(ddd)y*ii", &search.frame.view, &search.height, &search.width,
                        &search.keep.view, &search.sample.view, &search.blur_px, &search.low, &search.high,
                        &search.weight, &search.share, &search.subpixel, &search.dim, &search.least_raised,
                        &search.clear, &table.view, &first, &rows))
    return nullptr;
  if (const char* fault = search.fault()) return refuse(fault);
  if (rows < 1 || !table.holds<double>(size_t{6} * rows * search.width)) return refuse("table: not of this size");
  try {
    Scratch& s = scratch();
    search.run(s);
    const size_t n = s.candidates.size(), blocks = s.channels == 3 ? 3 : 2;
    PyObject* result = PyByteArray_FromStringAndSize(nullptr, blocks * 2 * n * sizeof(float));
    if (!result) return nullptr;
    Out<float> out(PyByteArray_AsString(result), n, blocks == 3);
    Chunk c;
    size_t kept = 0;
    for (size_t begin = 0; begin < n; begin += kChunk) {
      measure_edges(s, search.height, search.width, search.subpixel, begin, std::min(begin + kChunk, n), c);
      for (int i = 0; i < c.n; ++i) c.v[i] += first;
      lift_edges(c, table.as<double>(), rows, search.width);
      kept = add_lifted(c, true, out, kept);
    }
    return shortened<float>(result, n, kept, blocks);
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
  Out<T> out(PyByteArray_AsString(result), n, blocks == 3);
  Chunk c;
  size_t kept = 0;
  for (size_t begin = 0; begin < n; begin += kChunk) {
    c.n = static_cast<int>(std::min<size_t>(kChunk, n - begin));
    for (int i = 0; i < c.n; ++i) {
      const size_t at = 2 * (begin + i);
      c.u[i] = uv.as<double>()[at];
      c.v[i] = uv.as<double>()[at + 1];
      c.normal_u[i] = normals.as<double>()[at];
      c.normal_v[i] = normals.as<double>()[at + 1];
      for (int k = 0; blocks == 3 && k < 2; ++k) c.share[k][i] = hues.as<double>()[at + k];
    }
    lift_edges(c, table.as<double>(), height, width);
    kept = add_lifted(c, finite, out, kept);
  }
  return shortened<T>(result, n, kept, blocks);
}

PyObject* lift(PyObject*, PyObject* args) {
  Buffer uv, normals, hues, table;
  int height, width, single;
  if (!PyArg_ParseTuple(args, "y*y*z*y*iip", &uv.view, &normals.view, &hues.view, &table.view, &height,
                        &width, &single))
    return nullptr;
  const size_t n = uv.view.len / (2 * sizeof(double));
  if (!normals.holds<uint8_t>(uv.view.len) || (hues.view.buf && !hues.holds<uint8_t>(uv.view.len)))
    return refuse("edges: positions, normals and hues differ in number");
  if (height < 1 || width < 1 || !table.holds<double>(size_t{6} * height * width))
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
  if (!normals.holds<uint8_t>(points.view.len) || (hues.view.buf && !hues.holds<uint8_t>(points.view.len)))
    return refuse("edges: points, normals and hues differ in number");
  if (rows < 1 || columns < 1 || planes < 1 || planes > 5 ||
      !out.holds<uint8_t>(static_cast<size_t>(planes) * rows * columns))
    return refuse("raster: not of this size");
  const auto fill = [&](auto type) {
    using T = decltype(type);
    mark_cells<T>(points.view.len / (2 * sizeof(T)), points.as<T>(), normals.as<T>(), hues.as<T>(),
                  T(left_cm), T(far_cm), T(cell_cm), rows, columns, planes, middle, T(steps),
                  out.into<uint8_t>());
  };
  if (single) fill(float{});
  else fill(double{});
  Py_RETURN_NONE;
}

PyMethodDef methods[] = {
    {"find", find, METH_VARARGS, nullptr},
    {"extract", extract, METH_VARARGS, nullptr},
    {"lift", lift, METH_VARARGS, nullptr},
    {"raster", raster, METH_VARARGS, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_kernels", nullptr, 0, methods, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__kernels() { return PyModuleDef_Init(&module); }
