#include "densify/grad2d.h"
#include "simd/simd.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

void accumulate(const Grad2dJob& job, std::int64_t first, std::int64_t last) {
  for (std::int64_t i = first; i < last; i += kLanes) {
    const int lanes = last - i < kLanes ? static_cast<int>(last - i) : kLanes;
    float ones[kLanes] = {};
    for (int lane = 0; lane < lanes; ++lane) ones[lane] = job.visible[i + lane];
    const Floats visible = load(ones);
    const int low = lanes < kLanes / 2 ? 2 * lanes : kLanes;  // floats of the first vector
    Floats x, y;
    deinterleave(load_first(job.means2d_grad + 2 * i, low),
                 load_first(job.means2d_grad + 2 * i + kLanes, 2 * lanes - low), x, y);
    x = x * broadcast(job.scale_x);
    y = y * broadcast(job.scale_y);
    const Floats norm = select_or_zero(broadcast(0.0f) < visible, sqrt(fma(x, x, y * y)));
    store_first(job.grad2d_sum + i, load_first(job.grad2d_sum + i, lanes) + norm, lanes);
    store_first(job.visible_count + i, load_first(job.visible_count + i, lanes) + visible, lanes);
  }
}

}  // namespace

extern const Grad2dKernels grad2d_kernels{accumulate};

}  // namespace XRGS_NS
}  // namespace xrgs
