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

void exp_backward(const float* v_y, const float* y, float* v_x, std::int64_t first,
                  std::int64_t last) {
  map(v_y, y, v_x, first, last, [](Floats gradient, Floats value) { return gradient * value; });
}

// e^-|x| / (1 + e^-|x|) for negative x and 1 / (1 + e^-|x|) for others: nothing overflows, and no
// value is below the normal numbers, so that it is the same where the processor flushes those to 0.
void logistic_forward(const float* x, float* y, std::int64_t first, std::int64_t last) {
  map(x, y, first, last, [](Floats a) {
    const Floats one = broadcast(1.0f);
    const Floats e = exp(-abs(a));
    return select(a < broadcast(0.0f), e, one) / (one + e);
  });
}

void logistic_backward(const float* v_y, const float* y, float* v_x, std::int64_t first,
                       std::int64_t last) {
  map(v_y, y, v_x, first, last,
      [](Floats gradient, Floats value) { return gradient * (value * (broadcast(1.0f) - value)); });
}

}  // namespace

extern const ActivationKernels activation_kernels{exp_forward, exp_backward, logistic_forward,
                                                  logistic_backward};

}  // namespace XRGS_NS
}  // namespace xrgs
