#include "densify/observe.h"
#include "simd.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

void observe(const Observation& job, std::int64_t first, std::int64_t last) {
  for (std::int64_t i = first; i < last; i += kLanes) {
    const int lanes = last - i < kLanes ? static_cast<int>(last - i) : kLanes;
    float ones[kLanes] = {};
    for (int lane = 0; lane < lanes; ++lane) ones[lane] = job.visible[i + lane];
    const Floats seen = load(ones);
    const int low = lanes < kLanes / 2 ? 2 * lanes : kLanes;  // floats of the first vector
    Floats x, y;
    deinterleave(load_first(job.slope + 2 * i, low),
                 load_first(job.slope + 2 * i + kLanes, 2 * lanes - low), x, y);
    x = x * splat(job.scale_x);
    y = y * splat(job.scale_y);
    const Floats norm = keep(splat(0.0f) < seen, sqrt(fma(x, x, y * y)));
    store_first(job.gradient + i, load_first(job.gradient + i, lanes) + norm, lanes);
    store_first(job.seen + i, load_first(job.seen + i, lanes) + seen, lanes);
  }
}

}  // namespace

extern const ObserveKernels observe_kernels{observe};

}  // namespace XRGS_NS
}  // namespace xrgs
