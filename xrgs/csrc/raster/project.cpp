// Projection, forward: parameters -> records, sixteen Gaussians in lanes.
//
// A Gaussian is visible if it is in front of the near plane, its opacity reaches alpha_min, and the
// box of its ellipse of reach (where opacity exp(-r^2 / 2) = alpha_min) overlaps the image. With
// the view's skips off, Gaussians that fail one of the last two are projected all the same.
#include "raster/sh.h"
#include "raster/stages.h"
#include "vector_math.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

constexpr float kLog2e = 1.44269504f;
constexpr float kSqrtLog2e = 1.20112241f;

// Added to the squared radius of reach (which is log2(opacity / alpha_min), at most 8 or so), so
// that rounding in the tests of tiles and blocks never drops a pixel.
constexpr float kReachMargin = 0.01f;

constexpr float kSmallest = 1.17549435e-38f;

XRGS_INLINE Floats finite_times_zero(const Inputs& in) {
  // Zero times a number is zero, and times what is no number is not: their sum tells.
  const Floats zero = splat(0.0f);
  Floats sum = in.mean.x * zero;
  for (Floats part : {in.mean.y, in.mean.z, in.qw, in.qx, in.qy, in.qz, in.scale.x, in.scale.y,
                      in.scale.z, in.opacity, in.offset_x, in.offset_y})
    sum = fma(part, zero, sum);
  return sum;
}

// Colours before the clamp at zero.
template <int Degree>
XRGS_INLINE Vector3 colors_of(const Parameters& p, std::int64_t group, int lanes,
                              std::uint32_t visible, const Vector3& direction, Shade& shade) {
  Padded padded;
  Vector3 c0;
  load_triples(padded.of(p.sh0, group, lanes, 3), c0.x, c0.y, c0.z);
  const Floats half = splat(0.5f);
  Vector3 color = add({half, half, half}, splat(kC0), c0);
  constexpr int kRest = rest_of(Degree);
  if constexpr (kRest > 0) {
    Floats basis[kRest], c[3 * kRest];
    sh_basis<Degree>(direction, basis);
    load_columns<3 * kRest>(p.shN + group * p.rest * 3, p.rest * 3, rows_to_load(visible, lanes),
                            c);
    for (int k = 0; k < kRest; ++k)
      color = add(color, basis[k], {c[3 * k], c[3 * k + 1], c[3 * k + 2]});
    for (int channel = 0; channel < 3; ++channel) {
      const Vector3 slope = sh_gradient<Degree>(direction, c + channel, 3);
      stream(shade.slope[3 * channel], slope.x);
      stream(shade.slope[3 * channel + 1], slope.y);
      stream(shade.slope[3 * channel + 2], slope.z);
    }
  }
  const Floats zero = splat(0.0f);
  shade.open[0] = static_cast<std::uint16_t>(bits(zero <= color.x));
  shade.open[1] = static_cast<std::uint16_t>(bits(zero <= color.y));
  shade.open[2] = static_cast<std::uint16_t>(bits(zero <= color.z));
  return color;
}

XRGS_INLINE Mask is_visible(const Projected& o, const View& v, Floats reach2) {
  // reach2 is in units of log2: 2 ln(opacity / alpha_min) = 2 ln 2 reach2.
  const Floats r2 = splat(2.0f / kLog2e) * reach2, zero = splat(0.0f), huge = splat(1e18f);
  const Floats extent_x = sqrt(r2 * o.xx), extent_y = sqrt(r2 * o.yy);
  const Mask usable =
      (zero < o.det) & (o.det < splat(3e38f)) & (extent_x < huge) & (extent_y < huge);
  const bool anywhere = !v.skips.out_of_view;  // then only what overflows is dropped
  const Floats left = anywhere ? -huge : zero;
  const Floats right = anywhere ? huge : splat(static_cast<float>(v.width));
  const Floats bottom = anywhere ? huge : splat(static_cast<float>(v.height));
  const Mask overlaps = (left < o.mean_x + extent_x) & (left < o.mean_y + extent_y) &
                        (o.mean_x - extent_x < right) & (o.mean_y - extent_y < bottom);
  const Floats opacity_min = splat(v.skips.sub_threshold ? v.alpha_min : kSmallest);
  return o.front & (opacity_min <= o.opacity) & usable & overlaps;
}

XRGS_INLINE void store_records(const Projected& o, Floats level, Floats reach2,
                               const Vector3& color, std::uint32_t visible, Record* records) {
  const Whitening white = whiten(o);
  const Floats scale = splat(kSqrtLog2e), zero = splat(0.0f);
  const Floats p = white.p * scale, s = white.s * scale, q = white.q * scale;
  const Floats inv_p = splat(1.0f) / p, inv_q = splat(1.0f) / q;
  const Floats margined = reach2 + splat(kReachMargin);
  const Floats reach = sqrt(margined);
  const Floats shear = s * inv_q;  // the rightmost point has v = u s / q
  const Floats tip = reach * shear * inv_q / sqrt(fma(shear, shear, splat(1.0f)));
  Floats rows[16] = {o.mean_x,
                     o.mean_y,
                     p,
                     s,
                     q,
                     level,
                     max(color.x, zero),
                     max(color.y, zero),
                     max(color.z, zero),
                     inv_p,
                     tip,
                     margined,
                     reach * inv_q,
                     zero,
                     zero,
                     zero};
  transpose(rows);
  for (int i = 0; i < 16; ++i)
    if ((visible >> i & 1u) != 0) stream(&records[i].x, rows[i]);
}

template <int Degree>
std::uint32_t project_sixteen(const Parameters& p, const View& v, std::int64_t group, int lanes,
                              Frame& frame, float* depths, bool* good) {
  const Inputs in = load_inputs(p, group, lanes);
  const Floats zero = splat(0.0f);
  const Mask good_input = (finite_times_zero(in) == zero) & (zero <= in.opacity) &
                          (in.opacity <= splat(1.0f)) &
                          (zero <= min(in.scale.x, min(in.scale.y, in.scale.z)));
  if (bits(good_input) != 0xffffu) *good = false;
  const Projected o = project_inputs(in, v);
  const Floats level = log2(max(o.opacity, splat(kSmallest)));
  const Floats reach2 = max(level - splat(v.level_min), zero);
  const std::uint32_t inside = lanes == 16 ? 0xffffu : (1u << lanes) - 1u;
  const std::uint32_t visible = bits(is_visible(o, v, reach2)) & inside;
  if (visible == 0) return 0;
  Floats inv;
  const Vector3 direction = direction_of(in.mean, v.position, inv);
  const Vector3 color = colors_of<Degree>(p, group, lanes, visible, direction,
                                          frame.shades[static_cast<std::size_t>(group / 16)]);
  const Mask finite =
      (color.x * zero == zero) & (color.y * zero == zero) & (color.z * zero == zero);
  if ((visible & ~bits(finite)) != 0) *good = false;
  store_records(o, level, reach2, color, visible, frame.records.data() + group);
  store(depths, o.z);
  return visible;
}

// An order of unsigned integers that is the order of the floats.
std::uint32_t key_of(float depth) {
  std::uint32_t key;
  std::memcpy(&key, &depth, sizeof key);
  return (key & 0x80000000u) != 0 ? ~key : key | 0x80000000u;
}

template <int Degree>
std::int64_t project_degree(const Parameters& p, const View& v, std::int64_t first,
                            std::int64_t last, Frame& frame, std::uint64_t* order, bool* good) {
  std::int64_t seen = 0;
  for (std::int64_t group = first; group < last; group += 16) {
    const int lanes = last - group < 16 ? static_cast<int>(last - group) : 16;
    alignas(64) float depths[16];
    const std::uint32_t visible = project_sixteen<Degree>(p, v, group, lanes, frame, depths, good);
    frame.visible[static_cast<std::size_t>(group / 16)] = static_cast<std::uint16_t>(visible);
    for (std::uint32_t left = visible; left != 0; left &= left - 1) {
      const int i = __builtin_ctz(left);
      order[seen++] = static_cast<std::uint64_t>(key_of(depths[i])) << 32 |
                      static_cast<std::uint64_t>(group + i);
    }
    for (int i = 0; i < lanes; ++i) frame.slots[static_cast<std::size_t>(group + i)] = {0, 0};
  }
  stream_fence();
  return seen;
}

}  // namespace

std::int64_t project(const Parameters& p, const View& v, std::int64_t first, std::int64_t last,
                     Frame& frame, std::uint64_t* order, bool* good) {
  switch (v.degree) {
    case 0:
      return project_degree<0>(p, v, first, last, frame, order, good);
    case 1:
      return project_degree<1>(p, v, first, last, frame, order, good);
    case 2:
      return project_degree<2>(p, v, first, last, frame, order, good);
    default:
      return project_degree<3>(p, v, first, last, frame, order, good);
  }
}

}  // namespace XRGS_NS
}  // namespace xrgs
