// What the stages of the rasterizer hand to one another. Plain data, the same for every copy of
// the kernels.
//
// A view goes: project (parameters -> records), sort (by depth), bin (a list of records for each
// tile), composite (lists -> image); and back: composite backward (image gradient -> a slot of sums
// for each (tile, Gaussian) pair), project backward (slots -> parameter gradients).
#pragma once

#include <cstdint>

namespace xrgs {

constexpr int kTile = 16;     // side of a tile, px: sixteen 4x4 blocks, one vector each
constexpr int kBlocks = 16;   // of a tile, row by row
constexpr int kBatch = 128;   // Gaussians of a tile that are composited at once
constexpr int kChunk = 1024;  // Gaussians that a task projects; a multiple of 16

// Work that is left out, each kind as long as it is true; the image is the same without.
struct Skips {
  bool out_of_view;    // Gaussians whose box of reach does not overlap the image
  bool sub_threshold;  // Gaussians whose opacity is below alpha_min
  bool tiles;          // tiles that the box of reach overlaps, but not the ellipse
  bool blocks;         // blocks of a tile that the ellipse does not reach
  bool saturated;      // what lies behind the last Gaussian that a block's pixels composite
};

// The camera and the settings, as the kernels need them.
struct View {
  float rotation[9];  // world to camera, row by row
  float translation[3];
  float position[3];  // of the camera, world units
  float fx, fy, cx, cy;
  int width, height;
  float near, eps2d;
  float alpha_min;  // at least the smallest normal number
  float level_min;  // log2 of alpha_min
  float alpha_max, transmittance_min;
  float background[3];
  bool antialiased;
  bool absgrad;  // the offsets' gradient is of each pixel's gradient the absolute value, summed
  int degree;    // highest band of the spherical harmonics that is on
  Skips skips;

  int columns() const { return (width + kTile - 1) / kTile; }
  int rows() const { return (height + kTile - 1) / kTile; }
};

// The Gaussians: activated parameters, float32, contiguous.
struct Parameters {
  std::int64_t count;
  const float* means;      // [N, 3]
  const float* quats;      // [N, 4] wxyz
  const float* scales;     // [N, 3]
  const float* opacities;  // [N]
  const float* sh0;        // [N, 3]
  const float* shN;        // [N, rest, 3]
  int rest;
  const float* offsets;  // [N, 2] px added to the projected means, or null
};

// Where their gradients go.
struct Gradients {
  float *means, *quats, *scales, *opacities, *sh0;
  float* shN;      // or null
  float* offsets;  // or null
};

// A visible Gaussian in the image plane: one cache line. With d = pixel centre - (x, y),
// u = p dx - s dy and v = q dy: alpha = 2^(level - u^2 - v^2). The inverse covariance as a sum of
// squares has no cancellation, where a dx^2 + 2 b dx dy + c dy^2 of a long needle loses all digits.
struct alignas(64) Record {
  float x, y;     // mean, px
  float p, s, q;  // px^-1
  float level;    // log2 of the opacity
  float red, green, blue;
  float inv_p;    // 1 / p
  float tip;      // dy of the rightmost point of the ellipse of reach, px
  float reach2;   // the ellipse of reach is u^2 + v^2 = reach2
  float reach_y;  // half its height, px
  float unused[3];
};
static_assert(sizeof(Record) == 64, "a record is one cache line");

// A Gaussian in a tile's list.
struct Entry {
  std::uint32_t gaussian;
  std::uint32_t slot;  // where the backward pass leaves this pair's sums
};

// How the colours of sixteen Gaussians move with the direction that they are seen from, kept from
// the forward pass so that the backward pass need not read the harmonics again.
struct alignas(64) Shade {
  float slope[9][16];     // d(red)/dx, d(red)/dy, d(red)/dz, d(green)/dx, ... before the clamp at 0
  std::uint16_t open[3];  // for red, green, blue: a bit where the clamp does not hold it
};

// The slots of a Gaussian: first, first + 1, ..., first + count - 1. They lie in the order of the
// Gaussians, so that the projection's backward pass reads them one after the other.
struct Slots {
  std::uint32_t first;
  std::uint32_t count;
};

// A (tile, Gaussian) pair as binning emits it, front to back.
struct Pair {
  std::uint32_t tile;
  std::uint32_t gaussian;
};

// A pair's sums over its pixels, with g = dL/d(ln alpha), w = the weight of its colour and
// v = dL/d(image): g, g dx, g dy, g dx^2, g dx dy, g dy^2, and w v for each colour; with absgrad
// also |g d(ln alpha)/dx| and |g d(ln alpha)/dy|, x and y the mean's, else zeros.
enum SlotField { kG, kGx, kGy, kGxx, kGxy, kGyy, kWr, kWg, kWb, kAbsX, kAbsY, kSlotFields };
constexpr int kSlotSize = 16;  // floats: one cache line

// Work of one batch of one tile, kept from the forward pass for the backward pass.
struct Batch {
  std::uint8_t counts[kBlocks];           // how far each block went in its list
  std::uint8_t lists[kBlocks][kBatch];    // places in the batch, front to back
  alignas(64) float before[kBlocks][16];  // transmittance of each pixel before the batch
};

}  // namespace xrgs
