// What the lane's width is believed to be: lane_width.py, compiled. What a step means stands there. Exponentials and
// logarithms are those of the C library, as Python's, and sums go from first to last, so that the bytes are equal
// (build with -ffp-contract=off). Arrays come as contiguous buffers of doubles.

#include "arguments.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstring>

// On x86-64 the loops exist twice, and the processor chooses.
#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif

namespace {

constexpr size_t kMost = 1024;                 // widths that are told apart
constexpr double kLost = 1.0 / (1ull << 60);  // far less than what a sum in double precision keeps

// WidthBelief._settle(): nats get their largest at 0; returns mean and variance of the logarithm.
void settle(double* nats, const double* logs, size_t n, double* probability, double* mean, double* variance) {
  double most = nats[0], total = 0.0;
  for (size_t i = 1; i < n; ++i) most = nats[i] > most ? nats[i] : most;
  for (size_t i = 0; i < n; ++i) {
    nats[i] -= most;
    probability[i] = std::exp(nats[i]);
    total += probability[i];
  }
  *mean = *variance = 0.0;
  for (size_t i = 0; i < n; ++i) {
    probability[i] /= total;
    *mean += probability[i] * logs[i];
  }
  for (size_t i = 0; i < n; ++i) *variance += probability[i] * ((logs[i] - *mean) * (logs[i] - *mean));
}

PyObject* learn(PyObject*, PyObject* args) {
  Buffer nats, prior, logs, probability;
  double log_width, sigma, own_share, others, kept, alike;
  if (!PyArg_ParseTuple(args, "w*y*y*w*dddddd", &nats.view, &prior.view, &logs.view, &probability.view, &log_width,
                        &sigma, &own_share, &others, &kept, &alike))
    return nullptr;
  const size_t n = nats.size<double>();
  const double log_others = std::log(others);
  if (n < 1 || !prior.holds<double>(n) || !logs.holds<double>(n) || !probability.holds<double>(n))
    return refuse("belief: arrays differ in number");
  for (size_t i = 0; i < n; ++i) {
    const double off = (logs.as<double>()[i] - log_width) / sigma;
    const double share = own_share * std::exp(-0.5 * (off * off));
    // Where the share is lost in rounding, which is so for most widths, the logarithm is known.
    const double likely = share < kLost * others ? log_others : std::log(share + others);
    const double told = kept * (nats.as<double>()[i] - prior.as<double>()[i]) + likely / alike;
    nats.into<double>()[i] = prior.as<double>()[i] + told;
  }
  double mean, variance;
  settle(nats.into<double>(), logs.as<double>(), n, probability.into<double>(), &mean, &variance);
  return Py_BuildValue("dd", mean, variance);
}

WIDE void spread(const double* probability, const double* kernel, size_t n, double* __restrict out) {
  std::memset(out, 0, n * sizeof(double));
  for (size_t j = 0; j < n; ++j) {
    const double *shifted = kernel + (n - 1 - j), share = probability[j];
    for (size_t i = 0; i < n; ++i) out[i] += shifted[i] * share;
  }
}

PyObject* match(PyObject*, PyObject* args) {
  Buffer probability, kernel, logs, widths;
  double step;
  if (!PyArg_ParseTuple(args, "y*y*y*y*d", &probability.view, &kernel.view, &logs.view, &widths.view, &step))
    return nullptr;
  const size_t n = probability.size<double>(), m = widths.size<double>();
  if (n < 2 || n > kMost || !probability.holds<double>(n) || !kernel.holds<double>(2 * n - 1) || !logs.holds<double>(n))
    return refuse("belief: arrays differ in number");
  double density[kMost];
  spread(probability.as<double>(), kernel.as<double>(), n, density);
  const double most = *std::max_element(density, density + n), *grid = logs.as<double>();
  PyObject* result = PyByteArray_FromStringAndSize(nullptr, m * sizeof(double));
  if (!result) return nullptr;
  double* out = reinterpret_cast<double*>(PyByteArray_AsString(result));
  for (size_t i = 0; i < m; ++i) {
    // Written so that NaN gives the first.
    double x = std::log(widths.as<double>()[i]);
    x = x > grid[0] ? std::min(x, grid[n - 1]) : grid[0];
    const size_t below = std::min(static_cast<size_t>((x - grid[0]) / step), n - 2);
    const double share = (x - grid[below]) / (grid[below + 1] - grid[below]);
    out[i] = (density[below] + (density[below + 1] - density[below]) * share) / most;
  }
  return result;
}

PyMethodDef methods[] = {
    {"learn", learn, METH_VARARGS, nullptr},
    {"match", match, METH_VARARGS, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_kernels", nullptr, 0, methods, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__kernels() { return PyModuleDef_Init(&module); }
