#include "activations/activations.h"
#include "simd/simd.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

// out[i] = function(in[i]) for i in first..last-1.
template <class Function>
XRGS_INLINE void map(const float* in, float* out, std::int64_t first, std::int64_t last,
                     Function function) {
  std::int64_t i = first;
  for (; i + kLanes <= last; i += kLanes) store(out + i, function(load(in + i)));
  if (i == last) return;
  const int lanes = static_cast<int>(last - i);
  store_first(out + i, function(load_first(in + i, lanes)), lanes);
}

// out[i] = function(a[i], b[i]) for i in first..last-1.
template <class Function>
XRGS_INLINE void map(const float* a, const float* b, float* out, std::int64_t first,
                     std::int64_t last, Function function) {
  std::int64_t i = first;
  for (; i + kLanes <= last; i += kLanes) store(out + i, function(load(a + i), load(b + i)));
  if (i == last) return;
  const int lanes = static_cast<int>(last - i);
  store_first(out + i, function(load_first(a + i, lanes), load_first(b + i, lanes)), lanes);
}

void exp_forward(const float* x, float* y, std::int64_t first, std::int64_t last) {
  map(x, y, first, last, [](Floats a) { return exp(a); });
}

void logistic_forward(const float* x, float* y, std::int64_t first, std::int64_t last) {
  map(x, y, first, last, [](Floats a) { return logistic(a); });
}

void exp_backward(const float* v_y, const float* y, float* v_x, std::int64_t first,
                  std::int64_t last) {
  map(v_y, y, v_x, first, last, [](Floats v, Floats value) { return exp_gradient(v, value); });
}

void logistic_backward(const float* v_y, const float* y, float* v_x, std::int64_t first,
                       std::int64_t last) {
  map(v_y, y, v_x, first, last, [](Floats v, Floats value) { return logistic_gradient(v, value); });
}

}  // namespace

extern const ActivationKernels activation_kernels{exp_forward, exp_backward, logistic_forward,
                                                  logistic_backward};

}  // namespace XRGS_NS
}  // namespace xrgs
