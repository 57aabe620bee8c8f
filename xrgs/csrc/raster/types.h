// The data between the stages of the rasterizer, as plain structs for all instruction sets.
// docs/rasterizer.md describes the stages, and derives the equations that comments refer to.
#pragma once

#include <cstdint>

namespace xrgs {

constexpr int kTileSize = 16;        // side of a tile, px: sixteen 4x4 blocks, one vector each
constexpr int kBlocksPerTile = 16;   // row by row
constexpr int kBatchSize = 128;      // Gaussians of a tile that are composited together
constexpr int kProjectChunk = 1024;  // Gaussians that one task projects; a multiple of 16
constexpr int kMaxShDegree = 3;      // of the spherical harmonics

// The number of basis functions of degree 1 to `degree`: K - 1 of shN [N, K - 1, 3].
constexpr int rest_basis_count(int degree) { return (degree + 1) * (degree + 1) - 1; }

// The largest magnitude of a colour and of the background, so that their weighted mean in a pixel
// can't overflow.
constexpr float kLargestColor = 1e38f;

// Work that the rasterizer skips. Each option, if true, skips one kind of work; apart from rounding
// at the thresholds, the image does not depend on it.
struct CullingOptions {
  bool out_of_view;    // Gaussians whose bounding box (Eq. 12) does not overlap the image
  bool sub_threshold;  // Gaussians whose opacity is below alpha_min
  bool tiles;          // tiles that the bounding box overlaps, but not the cutoff ellipse (Eq. 13)
  bool blocks;         // 4x4 blocks of a tile that the cutoff ellipse does not overlap
  bool saturated;      // Gaussians behind the last one that any pixel of a block composites
};

// The camera and the settings of one render.
struct RenderConfig {
  float rotation[9];         // world to camera, row by row
  float translation[3];      // world to camera
  float camera_position[3];  // world units
  float fx, fy, cx, cy;      // px
  int width, height;         // px
  float near;                // world units
  float eps2d;               // px^2, added to the diagonal of the 2D covariance
  float alpha_min;           // at least the smallest normal number
  float log2_alpha_min;
  float alpha_max, transmittance_min;
  float background[3];
  bool antialiased;  // compensate opacities for eps2d (Eq. 10)
  bool absgrad;      // the gradient of means2d_offset sums absolute values over pixels (Eq. 21)
  bool raw;          // scales are natural logarithms and opacities logits, which are activated here
  int sh_degree;     // the highest degree of the spherical harmonics that is used, 0 to 3
  CullingOptions culling;

  int tile_columns() const { return (width + kTileSize - 1) / kTileSize; }
  int tile_rows() const { return (height + kTileSize - 1) / kTileSize; }
  std::int64_t tile_count() const { return std::int64_t{tile_columns()} * tile_rows(); }
};

// Faults for which a render has no image.
constexpr std::uint32_t kWrongParameter = 1;  // not finite or out of range
constexpr std::uint32_t kTooLarge = 2;        // a Gaussian's size in px overflows float32

// The Gaussians: float32, contiguous; scales and opacities as RenderConfig::raw says.
struct GaussianParameters {
  std::int64_t count;           // N
  const float* means;           // [N, 3]
  const float* quats;           // [N, 4] wxyz
  const float* scales;          // [N, 3]
  const float* opacities;       // [N]
  const float* sh0;             // [N, 3]
  const float* shN;             // [N, rest_count, 3]
  int rest_count;               // number of stored basis functions above degree 0, at most 15
  const float* means2d_offset;  // [N, 2] px added to the projected means, or null
};

// The arrays for the gradients of the parameters, with the shapes above.
struct ParameterGradients {
  float *means, *quats, *scales, *opacities, *sh0;
  float* shN;             // null if not needed
  float* means2d_offset;  // null if not needed
};

// A visible Gaussian in the image plane: one cache line. With d = pixel centre - mean2d,
//   u = chol_xx dx - chol_xy dy,  v = chol_yy dy,  alpha = 2^(log2_opacity - u^2 - v^2)
// (Eq. 7 and 8).
// chol_* is the Cholesky factor of the conic (the inverse of the 2D covariance), scaled for an
// exponent of base 2. gsplat's form of the conic, a dx^2 + 2 b dx dy + c dy^2, loses all digits to
// cancellation for a long thin Gaussian; a sum of squares does not.
struct alignas(64) ProjectedGaussian {
  float mean2d_x, mean2d_y;         // px
  float chol_xx, chol_xy, chol_yy;  // px^-1; chol_xy has the sign of the covariance
  float log2_opacity;               // compensated if antialiased
  float red, green, blue;           // at least 0
  float inv_chol_xx;                // px
  float dy_at_xmax;                 // dy of the rightmost point of the cutoff ellipse, px
  float cutoff_radius_sq;           // the cutoff ellipse is u^2 + v^2 = cutoff_radius_sq (Eq. 11)
  float radius_y;                   // half the height of the cutoff ellipse, px
  float unused[3];
};
static_assert(sizeof(ProjectedGaussian) == 64, "a projected Gaussian is one cache line");

// A Gaussian in the list of a tile.
struct TileEntry {
  std::uint32_t gaussian;
  std::uint32_t pair;  // row of pair_grads that belongs to this (tile, Gaussian) pair
};

// Derivatives of the colours of sixteen Gaussians with respect to the viewing direction. The
// forward pass stores them, so that the backward pass does not read the spherical harmonics, three
// quarters of the parameters.
struct alignas(64) ColorDerivatives {
  // d(red)/dx, d(red)/dy, d(red)/dz, d(green)/dx, ... of the colour before the clamp at 0.
  float dcolor_ddir[9][16];
  // For red, green and blue: bit i is set if the colour of Gaussian i is not clamped.
  std::uint16_t unclamped[3];
};

// The (tile, Gaussian) pairs of a Gaussian: rows first..first + count - 1 of pair_grads. Rows are
// sorted by Gaussian, so the backward projection reads them sequentially.
struct PairRange {
  std::uint32_t first;
  std::uint32_t count;
};

// A (tile, Gaussian) pair of the stage intersect_tiles, in front-to-back order.
struct TileIntersection {
  std::uint32_t tile;
  std::uint32_t gaussian;
};

// The columns of pair_grads [pairs, kPairGradStride]: sums over the pixels of a pair. With
// g = dL/d(ln alpha), w = alpha T, and u and dy as in Eq. 8, they are
//   g, g u, g dy, g u^2, g u dy, g dy^2, and w v_image for each colour (Eq. 18);
// with absgrad also |dL/d(mean2d)| for x and y (Eq. 21), else zeros.
enum PairGradField {
  kGrad,
  kGradU,
  kGradDy,
  kGradUU,
  kGradUDy,
  kGradDyDy,
  kGradRed,
  kGradGreen,
  kGradBlue,
  kAbsGradX,
  kAbsGradY,
  kPairGradFields
};
constexpr int kPairGradStride = 16;  // floats: one cache line

// The data of one batch of a tile that the forward pass saves for the backward pass.
struct SavedBatch {
  std::uint8_t counts[kBlocksPerTile];             // Gaussians that each block composited
  std::uint8_t lists[kBlocksPerTile][kBatchSize];  // their positions in the batch, front to back
  alignas(64) float transmittance[kBlocksPerTile][16];  // of each pixel, in front of the batch
};

}  // namespace xrgs
