// The projection stage: from parameters to projected Gaussians, sixteen at a time. With the culling
// options off, those of a low opacity, and those outside the image, are projected too.
#include <cstring>

#include "raster/sh.h"
#include "raster/stages.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

constexpr float kLog2e = 1.44269504f;
constexpr float kSqrtLog2e = 1.20112241f;

// Added to cutoff_radius_sq = log2(opacity / alpha_min), so that rounding in the tests of tiles and
// blocks never drops a pixel. With the default alpha_min, cutoff_radius_sq is at most 8.
constexpr float kCutoffMargin = 0.01f;

// Zero if all inputs are finite, otherwise NaN: zero times infinity or NaN is NaN.
XRGS_INLINE Floats sum_times_zero(const GaussianInputs& in) {
  const Floats zero = broadcast(0.0f);
  Floats sum = in.mean.x * zero;
  for (Floats part : {in.mean.y, in.mean.z, in.qw, in.qx, in.qy, in.qz, in.scale.x, in.scale.y,
                      in.scale.z, in.opacity, in.offset_x, in.offset_y})
    sum = fma(part, zero, sum);
  return sum;
}

XRGS_INLINE Mask valid_inputs(const GaussianInputs& in) {
  const Floats zero = broadcast(0.0f);
  return (sum_times_zero(in) == zero) & (zero <= in.opacity) & (in.opacity <= broadcast(1.0f)) &
         (zero <= min(in.scale.x, min(in.scale.y, in.scale.z)));
}

// The colours before the clamp at zero (Eq. 9), and their derivatives for the backward pass.
template <int Degree>
XRGS_INLINE Vector3 unclamped_colors(const GaussianParameters& p, std::int64_t group, int lanes,
                                     std::uint32_t visible, const Vector3& direction,
                                     ColorDerivatives& derivatives) {
  PaddedRows padded;
  Vector3 c0;
  load_triples(padded.of(p.sh0, group, lanes, 3), c0.x, c0.y, c0.z);
  const Floats half = broadcast(0.5f);
  Vector3 color = add_scaled({half, half, half}, broadcast(kC0), c0);
  constexpr int kRest = rest_basis_count(Degree);
  if constexpr (kRest > 0) {
    Floats basis[kRest], c[3 * kRest];
    sh_basis<Degree>(direction, basis);
    load_columns<3 * kRest>(p.shN + group * p.rest_count * 3, p.rest_count * 3,
                            rows_to_load(visible, lanes), c);
    for (int k = 0; k < kRest; ++k)
      color = add_scaled(color, basis[k], {c[3 * k], c[3 * k + 1], c[3 * k + 2]});
    for (int channel = 0; channel < 3; ++channel) {
      const Vector3 gradient = sh_direction_gradient<Degree>(direction, c + channel, 3);
      stream(derivatives.dcolor_ddir[3 * channel], gradient.x);
      stream(derivatives.dcolor_ddir[3 * channel + 1], gradient.y);
      stream(derivatives.dcolor_ddir[3 * channel + 2], gradient.z);
    }
  }
  const Floats zero = broadcast(0.0f);
  derivatives.unclamped[0] = static_cast<std::uint16_t>(to_bits(zero <= color.x));
  derivatives.unclamped[1] = static_cast<std::uint16_t>(to_bits(zero <= color.y));
  derivatives.unclamped[2] = static_cast<std::uint16_t>(to_bits(zero <= color.z));
  return color;
}

// Returns a bit for each visible Gaussian. Sets kTooLarge for a Gaussian that would be visible, but
// whose size overflows float32.
XRGS_INLINE std::uint32_t find_visible(const Projection& o, const RenderConfig& config,
                                       Floats in_opacity, Floats cutoff_radius_sq,
                                       std::uint32_t existing, std::uint32_t* faults) {
  // The squared radius in standard deviations is 2 ln(opacity / alpha_min) = 2 ln 2
  // cutoff_radius_sq.
  const Floats sigma_sq = broadcast(2.0f / kLog2e) * cutoff_radius_sq;
  const Floats zero = broadcast(0.0f), huge = broadcast(1e18f);
  Floats extent_x = sqrt(sigma_sq * o.xx), extent_y = sqrt(sigma_sq * o.yy);  // Eq. 12
  if (any(o.huge)) {
    extent_x = select(o.huge, broadcast(kHugePixel) * extent_x, extent_x);
    extent_y = select(o.huge, broadcast(kHugePixel) * extent_y, extent_y);
  }
  const Mask in_range = (o.det < broadcast(3e38f)) & (extent_x < huge) & (extent_y < huge);
  const bool anywhere = !config.culling.out_of_view;  // then only overflows are dropped
  const Floats left = anywhere ? -huge : zero;
  const Floats right = anywhere ? huge : broadcast(static_cast<float>(config.width));
  const Floats bottom = anywhere ? huge : broadcast(static_cast<float>(config.height));
  const Mask overlaps = (left < o.mean_x + extent_x) & (left < o.mean_y + extent_y) &
                        (o.mean_x - extent_x < right) & (o.mean_y - extent_y < bottom);
  const Floats opacity_min =
      broadcast(config.culling.sub_threshold ? config.alpha_min : kSmallestNormal);
  const Floats most = broadcast(3.4028235e38f);
  const Mask placed = o.in_front & (abs(o.mean_x) <= most) & (abs(o.mean_y) <= most);
  const std::uint32_t drawn = to_bits(placed & (opacity_min <= in_opacity)) & existing;
  if ((drawn & ~to_bits(in_range)) != 0) *faults |= kTooLarge;
  const Mask visible = (zero < o.det) & in_range & overlaps & (opacity_min <= o.opacity);
  return drawn & to_bits(visible);
}

XRGS_INLINE void store_projected(const Projection& o, Floats log2_opacity, Floats cutoff_radius_sq,
                                 const Vector3& color, std::uint32_t visible,
                                 ProjectedGaussian* projected) {
  ConicFactor factor = conic_factor(o);
  if (any(o.huge)) {
    factor.xx = o.unit * factor.xx;
    factor.xy = o.unit * factor.xy;
    factor.yy = o.unit * factor.yy;
  }
  const Floats to_base_2 = broadcast(kSqrtLog2e), zero = broadcast(0.0f);
  const Floats chol_xx = factor.xx * to_base_2, chol_xy = factor.xy * to_base_2;
  const Floats chol_yy = factor.yy * to_base_2;
  const Floats inv_xx = broadcast(1.0f) / chol_xx, inv_yy = broadcast(1.0f) / chol_yy;
  const Floats radius_sq = cutoff_radius_sq + broadcast(kCutoffMargin);
  const Floats radius = sqrt(radius_sq);
  const Floats shear = chol_xy * inv_yy;  // the rightmost point has v = u chol_xy / chol_yy
  const Floats dy_at_xmax = radius * shear * inv_yy / sqrt(fma(shear, shear, broadcast(1.0f)));
  Floats rows[16] = {o.mean_x,
                     o.mean_y,
                     chol_xx,
                     chol_xy,
                     chol_yy,
                     log2_opacity,
                     max(color.x, zero),
                     max(color.y, zero),
                     max(color.z, zero),
                     inv_xx,
                     dy_at_xmax,
                     radius_sq,
                     radius * inv_yy,
                     zero,
                     zero,
                     zero};
  transpose(rows);
  for (int i = 0; i < 16; ++i)
    if ((visible >> i & 1u) != 0) stream(&projected[i].mean2d_x, rows[i]);
}

// Projects Gaussians group..group+lanes-1. Returns a bit for each visible one and stores their
// depths.
template <int Degree>
std::uint32_t project_group(const GaussianParameters& p, const RenderConfig& config,
                            std::int64_t group, int lanes, Frame& frame, float* depths,
                            std::uint32_t* faults) {
  const GaussianInputs in = load_inputs(p, config.raw, group, lanes);
  if (to_bits(valid_inputs(in)) != 0xffffu) *faults |= kWrongParameter;
  const Projection o = project_inputs(in, config);
  const Floats log2_opacity = log2(max(o.opacity, broadcast(kSmallestNormal)));
  const Floats cutoff_radius_sq =
      max(log2_opacity - broadcast(config.log2_alpha_min), broadcast(0.0f));
  const std::uint32_t existing = lanes == 16 ? 0xffffu : (1u << lanes) - 1u;
  const std::uint32_t visible =
      find_visible(o, config, in.opacity, cutoff_radius_sq, existing, faults);
  if (visible == 0) return 0;
  Floats inv_distance;
  const Vector3 direction = view_direction(in.mean, config.camera_position, inv_distance);
  const Vector3 color =
      unclamped_colors<Degree>(p, group, lanes, visible, direction,
                               frame.color_derivatives[static_cast<std::size_t>(group / 16)]);
  const Floats largest = broadcast(kLargestColor);
  const Mask in_range =
      (abs(color.x) <= largest) & (abs(color.y) <= largest) & (abs(color.z) <= largest);
  if ((visible & ~to_bits(in_range)) != 0) *faults |= kWrongParameter;
  store_projected(o, log2_opacity, cutoff_radius_sq, color, visible,
                  frame.projected.data() + group);
  store(depths, o.z);
  return visible;
}

// An unsigned integer whose order is that of the floats.
std::uint32_t depth_key(float depth) {
  std::uint32_t key;
  std::memcpy(&key, &depth, sizeof key);
  return (key & 0x80000000u) != 0 ? ~key : key | 0x80000000u;
}

template <int Degree>
std::int64_t project_degree(const GaussianParameters& p, const RenderConfig& config,
                            std::int64_t first, std::int64_t last, Frame& frame,
                            std::uint64_t* sort_keys, std::uint32_t* faults) {
  std::int64_t visible_count = 0;
  for (std::int64_t group = first; group < last; group += 16) {
    const int lanes = last - group < 16 ? static_cast<int>(last - group) : 16;
    alignas(64) float depths[16];
    const std::uint32_t visible =
        project_group<Degree>(p, config, group, lanes, frame, depths, faults);
    frame.visible[static_cast<std::size_t>(group / 16)] = static_cast<std::uint16_t>(visible);
    for (std::uint32_t remaining = visible; remaining != 0; remaining &= remaining - 1) {
      const int i = __builtin_ctz(remaining);
      sort_keys[visible_count++] = static_cast<std::uint64_t>(depth_key(depths[i])) << 32 |
                                   static_cast<std::uint64_t>(group + i);
    }
    for (int i = 0; i < lanes; ++i) frame.pair_ranges[static_cast<std::size_t>(group + i)] = {0, 0};
  }
  stream_fence();
  return visible_count;
}

}  // namespace

std::int64_t project(const GaussianParameters& p, const RenderConfig& config, std::int64_t first,
                     std::int64_t last, Frame& frame, std::uint64_t* sort_keys,
                     std::uint32_t* faults) {
  switch (config.sh_degree) {
    case 0:
      return project_degree<0>(p, config, first, last, frame, sort_keys, faults);
    case 1:
      return project_degree<1>(p, config, first, last, frame, sort_keys, faults);
    case 2:
      return project_degree<2>(p, config, first, last, frame, sort_keys, faults);
    default:
      return project_degree<3>(p, config, first, last, frame, sort_keys, faults);
  }
}

}  // namespace XRGS_NS
}  // namespace xrgs
