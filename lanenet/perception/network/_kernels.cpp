// Lines on the edge points of their markings: refinement.py, compiled. What a step means and where its numbers come from
// stands there. Every sum is taken in the order of the Python code, in double precision, so that the bytes are equal
// (build with -ffp-contract=off). Arrays come as contiguous buffers, whose types compiled.py sees to.

#include "../arguments.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <exception>
#include <limits>
#include <vector>

// On x86-64 the loops over edge points exist twice, and the processor chooses.
#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif
// Part of its caller, for whichever processor that is compiled.
#ifdef __GNUC__
#define WITHIN inline __attribute__((always_inline))
#else
#define WITHIN inline
#endif

namespace {

constexpr int kRows = 3, kNodes = 8, kSteps = 2, kPlaces = 4;  // label rows, nodes, steps, bins beside a row
constexpr int kMost = 128, kMostBins = 64;                     // edge points of a line, bins along it
constexpr int kAsked = 10, kPerLine = 15;                     // numbers of a line, before and after
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

// The settings, as _NUMBERS of refinement.py has them.
struct Numbers {
  double basis[kRows][3], correlation[kRows][kRows], smooth[kNodes][kNodes], nodes_cm[kNodes];
  double rows_at[kRows], beside[kRows][kPlaces], gates_cm[kSteps], cauchies_cm[kSteps];
  double near_cm, far_cm, first_cm, last_cm, bent_first_cm, bent_cm, bent_sigmas, loose_cm;
  double cosine, roughly, edge_cm, edge_growth, cauchy_cm, independent, hue, least, most;
  double marking_cm[2], seen_cm, bin_cm, node_cm, golden, least_variance, bent_steps;
};

// Edge points within the label rows.
struct Near {
  std::vector<double> x, y, normal_x, normal_y, yellow, red;
  std::vector<double> key, chosen;
  std::vector<std::int64_t> beside;  // as wide as what is compared, so that four are at a time
  std::vector<int> index;
  int count;
};

// Edge points of one line.
struct Beside {
  double x[kMost], y[kMost], normal_x[kMost], normal_y[kMost], yellow[kMost], red[kMost], certain[kMost];
  double at[kRows][kMost], change[kMost][kRows + 1];
  double slope[kMost], beyond[kMost], across[kMost], agree[kMost], gap[kMost];
  double weight[kMost], gate[kMost], share[2][kMost], lean[2][kMost], bent[kMost];
  // Node before each, bin in which it lies, and those that count at present.
  int node[kMost], bin[kMost], active[kMost], n;
  // Neighbours between the same two nodes: the first of each run, and the one after the last.
  int run[kMost + 1], runs;
};

struct Parabola {
  double a, b, c;
};

// Four numbers at a time.
#ifdef __GNUC__
typedef double Four __attribute__((vector_size(32)));
#else
struct Four {
  double at[4];
  double operator[](int i) const { return at[i]; }
  Four operator*(double factor) const { return {{at[0] * factor, at[1] * factor, at[2] * factor, at[3] * factor}}; }
  void operator+=(const Four& more) {
    for (int i = 0; i < 4; ++i) at[i] += more.at[i];
  }
};
inline Four operator*(double factor, const Four& four) { return four * factor; }
#endif

// x of lines at y, as _line_at().
inline Parabola parabola_of(const double* basis, const double* points) {
  double out[3];
  for (int k = 0; k < 3; ++k) {
    out[k] = 0.0;
    for (int j = 0; j < kRows; ++j) out[k] += points[j] * basis[3 * j + k];
  }
  return {out[0], out[1], out[2]};
}

inline double sign_of(double x) { return (x > 0.0) - (x < 0.0); }

// _inverse() of one matrix.
template <int n>
WITHIN void invert(double (*m)[n]) {
  for (int i = 0; i < n; ++i) {
    double row[n];
    const double scale = 1.0 / m[i][i];
    for (int j = 0; j < n; ++j) row[j] = m[i][j] * scale;
    row[i] = scale;
    for (int k = 0; k < n; ++k) {
      const double column = m[k][i];
      m[k][i] = 0.0;
      for (int j = 0; j < n; ++j) m[k][j] -= column * row[j];
    }
    for (int j = 0; j < n; ++j) m[i][j] = row[j];
  }
}

template <int n>
WITHIN void times(const double (*matrix)[n], const double* vector, double* out) {
  for (int i = 0; i < n; ++i) {
    out[i] = 0.0;
    for (int j = 0; j < n; ++j) out[i] += matrix[i][j] * vector[j];
  }
}

template <class T>
void take_near(const Numbers& s, const T* points, const T* normals, const T* hues, size_t n, Near& out) {
  for (auto* values : {&out.x, &out.y, &out.normal_x, &out.normal_y, &out.yellow, &out.red, &out.key, &out.chosen})
    values->resize(n);
  out.beside.resize(n);
  out.index.resize(n);
  // Every index is written, and the next one over it unless it counts: so there is no branch to guess.
  int count = 0;
  for (size_t i = 0; i < n; ++i) {
    const double y = points[2 * i + 1];
    out.index[count] = static_cast<int>(i);
    count += (y > s.near_cm) & (y < s.far_cm);
  }
  for (int k = 0; k < count; ++k) {
    const size_t i = out.index[k];
    const double spread = k * s.golden;
    out.x[k] = points[2 * i];
    out.y[k] = points[2 * i + 1];
    out.normal_x[k] = normals[2 * i];
    out.normal_y[k] = normals[2 * i + 1];
    out.yellow[k] = hues ? hues[2 * i] : 0.0;
    out.red[k] = hues ? hues[2 * i + 1] : 0.0;
    out.key[k] = spread - static_cast<int>(spread);
  }
  out.count = count;
}

// Whether each edge point is within reach of a line and runs roughly along it; squares save the roots.
WIDE void look_beside(const double* x, const double* y, const double* normal_x, const double* normal_y, int n,
                      double a, double b, double c, double reach_cm, double roughly, std::int64_t* __restrict beside) {
  const double a2 = 2.0 * a, reach2 = reach_cm * reach_cm, roughly2 = roughly * roughly;
  for (int i = 0; i < n; ++i) {
    const double slope = a2 * y[i] + b, steep = 1.0 + slope * slope;
    const double off = x[i] - ((a * y[i] + b) * y[i] + c), facing = normal_x[i] - normal_y[i] * slope;
    beside[i] = (off * off < reach2 * steep) & (facing * facing > roughly2 * steep) ? 1 : 0;
  }
}

// The smallest key above kMost others, of the first `count` points in `index`: keys are spread evenly from 0 to 1, so
// that of as many bins only one is sorted.
double smallest_key(Near& near, int count) {
  int filled[kMost + 1] = {};
  for (int k = 0; k < count; ++k) ++filled[static_cast<int>(near.key[near.index[k]] * kMost)];
  int bin = 0, below = 0;
  while (below + filled[bin] <= kMost) below += filled[bin++];
  double* there = near.chosen.data();
  int n = 0;
  for (int k = 0; k < count; ++k) {
    there[n] = near.key[near.index[k]];
    n += static_cast<int>(there[n] * kMost) == bin;
  }
  std::nth_element(there, there + (kMost - below), there + n);
  return there[kMost - below];
}

// RoadBorders.beside() of one line.
void choose(const Numbers& s, const Parabola& line, double reach_cm, Near& near, Beside& out) {
  const int n = near.count;
  look_beside(near.x.data(), near.y.data(), near.normal_x.data(), near.normal_y.data(), n, line.a, line.b, line.c,
              reach_cm, s.roughly, near.beside.data());
  int* index = near.index.data();
  int count = 0;
  for (int i = 0; i < n; ++i) {
    index[count] = i;
    count += static_cast<int>(near.beside[i]);
  }
  if (count > kMost) {
    const double most = smallest_key(near, count);
    int left = 0;
    for (int k = 0; k < count; ++k) {
      index[left] = index[k];
      left += near.key[index[k]] < most;
    }
    count = left;
  }
  out.n = count;
  for (int k = 0; k < out.n; ++k) {
    const int i = index[k];
    out.x[k] = near.x[i];
    out.y[k] = near.y[i];
    out.normal_x[k] = near.normal_x[i];
    out.normal_y[k] = near.normal_y[i];
    out.yellow[k] = near.yellow[i];
    out.red[k] = near.red[i];
  }
}

WIDE void weigh_looks(const Numbers& s, double sign, double yellow, double red, Beside& e) {
  const bool known = !std::isnan(yellow) && !std::isnan(red);
  for (int i = 0; i < e.n; ++i) {
    const double spread = s.edge_cm + s.edge_growth * (e.y[i] > 0.0 ? e.y[i] : 0.0);
    e.certain[i] = 1.0 / (spread * spread);
  }
  for (int i = 0; known && i < e.n; ++i) {
    const double off_yellow = sign * e.yellow[i] - yellow, off_red = sign * e.red[i] - red;
    const double unlike = 1.0 + (off_yellow * off_yellow + off_red * off_red) / (s.hue * s.hue);
    e.certain[i] /= unlike * unlike;
  }
  for (int k = 0; k < kRows; ++k)
    for (int i = 0; i < e.n; ++i) e.at[k][i] = (e.y[i] * s.basis[k][0] + s.basis[k][1]) * e.y[i] + s.basis[k][2];
}

// Lists the edge points with a weight: sums over them take no branch that is hard to guess.
WITHIN int list_active(Beside& e) {
  int count = 0;
  for (int i = 0; i < e.n; ++i) {
    e.active[count] = i;
    count += e.weight[i] != 0.0;
  }
  return count;
}

// The same, and divides the weights where more points than are independent share them.
WITHIN int share_weights(const Numbers& s, Beside& e) {
  const int count = list_active(e);
  const double crowd = count / s.independent;
  for (int i = 0; crowd > 1.0 && i < e.n; ++i) e.weight[i] /= crowd;
  return count;
}

// Gaps to the borders of a marking along a parabola, and the weights of those within the gate.
WIDE int weigh_parabola(const Numbers& s, const Parabola& line, double marking, double gate, double cauchy,
                        Beside& e) {
  const double a2 = 2.0 * line.a, per_cauchy = 1.0 / cauchy;
  for (int i = 0; i < e.n; ++i) {
    const double y = e.y[i], slope = a2 * y + line.b, across = 1.0 / std::sqrt(1.0 + slope * slope);
    const double agree = (e.normal_x[i] - e.normal_y[i] * slope) * across;
    const double side = agree > 0.0 ? 1.0 : agree < 0.0 ? -1.0 : 0.0;
    const double gap = (e.x[i] - ((line.a * y + line.b) * y + line.c)) * across + 0.5 * side * marking;
    const bool near = (std::abs(agree) > s.cosine) & (std::abs(gap) < gate);
    const double share = gap * per_cauchy;
    for (int k = 0; k < kRows; ++k) e.change[i][k] = e.at[k][i] * -across;
    e.change[i][kRows] = 0.5 * side;
    e.gap[i] = gap;
    e.weight[i] = near ? e.certain[i] / (1.0 + share * share) : 0.0;
  }
  return share_weights(s, e);
}

// The same along a line that bends.
WIDE int weigh_bent(const Numbers& s, double marking, const double* extra, double* gate, Beside& e) {
  const double per_cauchy = 1.0 / s.cauchy_cm;
  for (int k = 0; k < e.runs; ++k) {
    const double near = extra[e.node[e.run[k]]], far = extra[e.node[e.run[k]] + 1];
    for (int i = e.run[k]; i < e.run[k + 1]; ++i) {
      e.bent[i] = e.share[0][i] * near + e.share[1][i] * far;
      e.weight[i] = e.lean[0][i] * near + e.lean[1][i] * far;
    }
  }
  for (int i = 0; i < e.n; ++i) {
    const double steep = e.slope[i] + e.weight[i], across = 1.0 / std::sqrt(1.0 + steep * steep);
    const double agree = (e.normal_x[i] - e.normal_y[i] * steep) * across;
    const double side = agree > 0.0 ? 1.0 : agree < 0.0 ? -1.0 : 0.0;
    const double gap = (e.beyond[i] - e.bent[i]) * across + 0.5 * side * marking;
    const double cosine = gate[i] > s.loose_cm ? s.roughly : s.cosine;
    const bool near = (std::abs(agree) > cosine) & (std::abs(gap) < gate[i]);
    const double far = gap * per_cauchy;
    e.across[i] = across;
    e.agree[i] = agree;
    e.gap[i] = gap;
    e.weight[i] = near ? e.certain[i] / (1.0 + far * far) : 0.0;
  }
  return share_weights(s, e);
}

// Adds the points' shares to the normal equations of the parabola.
WITHIN void add_parabola(const Beside& e, int count, double* gaps, double (*told)[4]) {
  Four sums[4] = {}, pulls = {};
  for (int k = 0; k < count; ++k) {
    const int i = e.active[k];
    Four change;
    std::memcpy(&change, e.change[i], sizeof change);
    const Four weighted = change * e.weight[i];
    pulls += weighted * e.gap[i];
    for (int j = 0; j < 4; ++j) sums[j] += weighted[j] * change;
  }
  std::memcpy(gaps, &pulls, sizeof pulls);
  std::memcpy(told, sums, sizeof sums);
}

// Adds those of all points to the normal equations of the bend. Neighbours mostly lie between the same two nodes,
// whose sums meanwhile are at hand.
WITHIN void add_bent(const Beside& e, int count, double* pull, double (*told)[kNodes]) {
  for (int k = 0; k < count;) {
    const int node = e.node[e.active[k]];
    double near_pull = pull[node], far_pull = pull[node + 1];
    double near_near = told[node][node], near_far = told[node][node + 1];
    double far_near = told[node + 1][node], far_far = told[node + 1][node + 1];
    for (; k < count && e.node[e.active[k]] == node; ++k) {
      const int i = e.active[k];
      const double across = e.across[i], weight = e.weight[i] * across;
      const double gap = e.gap[i] + e.bent[i] * across, near = e.share[0][i], far = e.share[1][i];
      const double near_weight = near * weight, far_weight = far * weight;
      near_pull += near_weight * gap;
      far_pull += far_weight * gap;
      near_near += near_weight * across * near;
      near_far += near_weight * across * far;
      far_near += far_weight * across * near;
      far_far += far_weight * across * far;
    }
    pull[node] = near_pull, pull[node + 1] = far_pull;
    told[node][node] = near_near, told[node][node + 1] = near_far;
    told[node + 1][node] = far_near, told[node + 1][node + 1] = far_far;
  }
}

// _refine() of one line, whose edge points are in `e`.
WIDE void refine_line(const Numbers& s, const double* points, const double* sigma, double marking, double marking_sigma,
                 bool any, Beside& e, double* out) {
  double prior[kRows][kRows], by_prior[kRows][kRows];
  for (int i = 0; i < kRows; ++i)
    for (int j = 0; j < kRows; ++j)
      prior[i][j] = sigma[i] * sigma[j] * s.correlation[i][j] + (i == j ? s.least_variance : 0.0);
  std::memcpy(by_prior, prior, sizeof prior);
  invert(by_prior);
  double start[4] = {points[0], points[1], points[2], marking}, found[4];
  std::memcpy(found, start, sizeof start);
  const double sign = sign_of(marking);
  bool enough = false;

  double information[4][4] = {};
  for (int i = 0; i < kRows; ++i)
    for (int j = 0; j < kRows; ++j) information[i][j] = by_prior[i][j];
  information[3][3] = 1.0 / (marking_sigma * marking_sigma);
  for (int step = 0; any && step < kSteps; ++step) {
    const int count =
        weigh_parabola(s, parabola_of(&s.basis[0][0], found), found[3], s.gates_cm[step], s.cauchies_cm[step], e);
    enough = count >= s.least;
    if (!enough) {
      std::memcpy(found, start, sizeof start);
      continue;
    }
    double told[4][4] = {}, gaps[4] = {};
    add_parabola(e, count, gaps, told);
    double off[4], pull[4], moved[4];
    for (int k = 0; k < 4; ++k) off[k] = start[k] - found[k];
    times(information, off, pull);
    for (int k = 0; k < 4; ++k) {
      pull[k] -= gaps[k];
      for (int j = 0; j < 4; ++j) told[k][j] = information[k][j] + told[k][j];
    }
    invert(told);
    times(told, pull, moved);
    for (int k = 0; k < 4; ++k) found[k] += moved[k];
    found[3] = sign * std::min(std::max(sign * found[3], s.marking_cm[0]), s.marking_cm[1]);
  }
  double *place = out, *deviation = out + 3, *look = out + 11;
  out[6] = found[3];
  out[7] = 0.0;
  out[14] = s.near_cm;
  for (int k = 0; k < kRows; ++k) {
    place[k] = start[k];
    deviation[k] = std::sqrt(prior[k][k]);
    out[8 + k] = 0.0;
    look[k] = kNaN;
  }
  if (!enough) return;

  const Parabola line = parabola_of(&s.basis[0][0], found);
  const double a2 = 2.0 * line.a;
  for (int i = 0; i < e.n; ++i) {
    const double y = e.y[i];
    e.slope[i] = a2 * y + line.b;
    e.beyond[i] = e.x[i] - ((line.a * y + line.b) * y + line.c);
    const int node = static_cast<int>((y - s.nodes_cm[0]) / s.node_cm);
    e.node[i] = node < 0 ? 0 : node > kNodes - 2 ? kNodes - 2 : node;
    e.bin[i] = static_cast<int>((y - s.near_cm) / s.bin_cm);
    e.gate[i] = s.bent_first_cm;
  }
  e.runs = 0;
  for (int i = 0; i < e.n; ++i)
    if (i == 0 || e.node[i] != e.node[i - 1]) e.run[e.runs++] = i;
  e.run[e.runs] = e.n;
  for (int k = 0; k < 2; ++k)
    for (int i = 0; i < e.n; ++i) {
      const double ahead = (s.nodes_cm[e.node[i] + k] - e.y[i]) / s.node_cm, share = 1.0 - std::abs(ahead);
      e.share[k][i] = share > 0.0 ? share : 0.0;
      e.lean[k][i] = share > 0.0 ? sign_of(ahead) / s.node_cm : 0.0;
    }
  double bent_information[kNodes][kNodes], covariance[kNodes][kNodes], off[kRows], pulled[kRows];
  double wanted[kNodes] = {}, extra[kNodes] = {}, reach[kNodes];
  std::memcpy(bent_information, s.smooth, sizeof bent_information);
  for (int k = 0; k < kRows; ++k) off[k] = points[k] - found[k];
  times(by_prior, off, pulled);
  for (int i = 0; i < kRows; ++i) {
    wanted[static_cast<int>(s.rows_at[i])] = pulled[i];
    for (int j = 0; j < kRows; ++j)
      bent_information[static_cast<int>(s.rows_at[i])][static_cast<int>(s.rows_at[j])] += by_prior[i][j];
  }
  for (int step = 0; step < s.bent_steps; ++step) {
    const int count = weigh_bent(s, found[3], extra, e.gate, e);
    double pull[kNodes] = {};
    std::memset(covariance, 0, sizeof covariance);
    add_bent(e, count, pull, covariance);
    for (int i = 0; i < kNodes; ++i) {
      pull[i] += wanted[i];
      for (int j = 0; j < kNodes; ++j) covariance[i][j] = bent_information[i][j] + covariance[i][j];
    }
    invert(covariance);
    times(covariance, pull, extra);
    for (int i = 0; i < kNodes; ++i)
      reach[i] = std::min(std::max(s.bent_sigmas * std::sqrt(covariance[i][i]), s.last_cm), s.bent_cm);
    for (int k = 0; k < e.runs; ++k) {
      const double near = reach[e.node[e.run[k]]], far = reach[e.node[e.run[k]] + 1];
      for (int i = e.run[k]; i < e.run[k + 1]; ++i) e.gate[i] = e.share[0][i] * near + e.share[1][i] * far;
    }
  }
  weigh_bent(s, found[3], extra, e.gate, e);
  bool seen[2][kMostBins] = {};
  const int bins = static_cast<int>((s.far_cm - s.near_cm) / s.bin_cm) + 1;
  int total = 0, filled = 0, first = bins, last = 0;
  double yellow = 0.0, red = 0.0;
  for (int i = 0; i < e.n; ++i)
    e.weight[i] = (std::abs(e.agree[i]) > s.cosine) & (std::abs(e.gap[i]) < s.seen_cm) ? 1.0 : 0.0;
  const int met = list_active(e);
  for (int k = 0; k < met; ++k) {
    const int i = e.active[k];
    yellow += e.yellow[i];
    red += e.red[i];
    seen[e.agree[i] > 0.0][e.bin[i]] = true;
  }
  for (int i = 0; i < bins; ++i) {
    total += seen[0][i] + seen[1][i];
    if (!seen[0][i] && !seen[1][i]) continue;
    ++filled;
    first = std::min(first, i);
    last = i + 1;
  }
  out[7] = 0.5 * s.bin_cm * total;
  for (int k = 0; k < kRows; ++k) {
    const int node = static_cast<int>(s.rows_at[k]);
    place[k] = found[k] + extra[node];
    deviation[k] = std::sqrt(covariance[node][node]);
    for (const double bin : s.beside[k])
      if (seen[0][static_cast<int>(bin)] || seen[1][static_cast<int>(bin)]) out[8 + k] = 1.0;
  }
  if (met == 0) return;
  out[14] = s.near_cm + s.bin_cm * last;
  look[0] = sign * yellow / met;
  look[1] = sign * red / met;
  look[2] = 1.0 - static_cast<double>(filled) / (last - first);
}

// --- Python ---

PyObject* refine(PyObject*, PyObject* args) {
  Buffer asked, edges, normals, edge_hues, numbers;
  int single;
  if (!PyArg_ParseTuple(args, "y*y*y*z*y*p", &asked.view, &edges.view, &normals.view, &edge_hues.view, &numbers.view,
                        &single))
    return nullptr;
  if (asked.size<double>() % kAsked) return refuse("lines: points, sigmas, markings and hues differ in number");
  const size_t m = asked.size<double>() / kAsked;
  const size_t pair = 2 * (single ? sizeof(float) : sizeof(double));
  if (edges.view.len % pair || normals.view.len != edges.view.len ||
      (edge_hues.view.buf && edge_hues.view.len != edges.view.len))
    return refuse("edges: points, normals and hues differ in number");
  if (numbers.view.len != sizeof(Numbers)) return refuse("numbers: not of this size");
  Numbers s;
  std::memcpy(&s, numbers.view.buf, sizeof s);
  const auto within = [](double value, int count) { return value >= 0.0 && value < count; };
  bool sound = s.most == kMost && s.bin_cm > 0.0 && within((s.far_cm - s.near_cm) / s.bin_cm, kMostBins - 1);
  for (int i = 0; i < kRows; ++i) {
    sound &= within(s.rows_at[i], kNodes);
    for (const double bin : s.beside[i]) sound &= within(bin, kMostBins);
  }
  if (!sound) return refuse("numbers: not those that this was compiled for");
  PyObject* result = PyByteArray_FromStringAndSize(nullptr, m * kPerLine * sizeof(double));
  if (!result) return nullptr;
  try {
    static Near near;  // one caller at a time: the interpreter's lock is held
    static Beside beside;
    double* out = reinterpret_cast<double*>(PyByteArray_AsString(result));
    const auto take = [&](auto type) {
      using T = decltype(type);
      take_near(s, edges.as<T>(), normals.as<T>(), edge_hues.as<T>(), edges.view.len / pair, near);
    };
    if (single) take(float{});
    else take(double{});
    const bool any = near.count >= s.least;
    for (size_t i = 0; i < m; ++i) {
      const double* line = asked.as<double>() + kAsked * i;
      const double marking = line[6];
      if (any) {
        choose(s, parabola_of(&s.basis[0][0], line), s.first_cm + s.bent_cm + std::abs(marking), near, beside);
        weigh_looks(s, sign_of(marking), line[8], line[9], beside);
      }
      refine_line(s, line, line + 3, marking, line[7], any, beside, out + kPerLine * i);
    }
    return result;
  } catch (const std::exception&) {
    Py_DECREF(result);
    return PyErr_NoMemory();
  }
}

PyMethodDef methods[] = {
    {"refine", refine, METH_VARARGS, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_kernels", nullptr, 0, methods, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__kernels() { return PyModuleDef_Init(&module); }
