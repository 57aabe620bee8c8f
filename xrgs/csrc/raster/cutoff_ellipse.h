// The horizontal extent of a Gaussian's cutoff ellipse within a strip of pixel rows.
//
// The ellipse (Eq. 11 and 13) is convex, so its rightmost point within a strip of rows is at dy =
// dy_at_xmax, as that of the whole ellipse, or at the row of the strip nearest to it. The leftmost
// point is found in the same way at -dy_at_xmax. The part within the strip is convex too, so it
// overlaps every column of pixels between the two points.
#pragma once

#include "raster/types.h"
#include "simd/simd.h"

namespace xrgs {
namespace XRGS_NS {

// Sixteen ellipses, or one in all lanes. The fields are those of ProjectedGaussian.
struct CutoffEllipse {
  Floats x, y, chol_xy, chol_yy, inv_chol_xx, dy_at_xmax, radius_sq, radius_y;
};

// Computes the extent left..right of the ellipse within the rows with pixel centres top..bottom.
// Returns the lanes whose ellipse overlaps these rows.
XRGS_INLINE Mask strip_extent(const CutoffEllipse& e, Floats top, Floats bottom, Floats& left,
                              Floats& right) {
  const Floats low = top - e.y, high = bottom - e.y;
  const Floats dy_right = clamp(e.dy_at_xmax, low, high);
  const Floats dy_left = clamp(-e.dy_at_xmax, low, high);
  const Floats v_right = e.chol_yy * dy_right, v_left = e.chol_yy * dy_left;
  const Floats half_right = sqrt_upper_bound(fnma(v_right, v_right, e.radius_sq));
  const Floats half_left = sqrt_upper_bound(fnma(v_left, v_left, e.radius_sq));
  right = fma(fma(e.chol_xy, dy_right, half_right), e.inv_chol_xx, e.x);
  left = fma(e.chol_xy * dy_left - half_left, e.inv_chol_xx, e.x);
  return (low <= e.radius_y) & (-e.radius_y <= high);
}

// The ellipses of sixteen projected Gaussians, transposed: fields[i] has the i-th field of each.
XRGS_INLINE CutoffEllipse cutoff_ellipse(const Floats (&fields)[16]) {
  return {fields[0], fields[1],  fields[3],  fields[4],
          fields[9], fields[10], fields[11], fields[12]};
}

// The ellipse of one projected Gaussian, in all lanes.
XRGS_INLINE CutoffEllipse cutoff_ellipse(const ProjectedGaussian& g) {
  return {broadcast(g.mean2d_x),         broadcast(g.mean2d_y),    broadcast(g.chol_xy),
          broadcast(g.chol_yy),          broadcast(g.inv_chol_xx), broadcast(g.dy_at_xmax),
          broadcast(g.cutoff_radius_sq), broadcast(g.radius_y)};
}

}  // namespace XRGS_NS
}  // namespace xrgs
