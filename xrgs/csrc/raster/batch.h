// A batch of a tile's Gaussians, brought near: their records side by side, the origin of x and y
// moved to the tile's centre.
#pragma once

#include "raster/frame.h"
#include "simd.h"
#include "vector_math.h"

namespace xrgs {
namespace XRGS_NS {

// The rows of a batch have the fields of a Record.
using Rows = float[kBatch][16];
enum RecordField { kX, kY, kP, kS, kQ, kLevel, kRed, kGreen, kBlue };

struct Tile {
  int column, row;
  std::size_t index;
  std::uint32_t begin, end;  // of its entries

  Tile(const Frame& frame, int tile)
      : column(tile % frame.view.columns()),
        row(tile / frame.view.columns()),
        index(static_cast<std::size_t>(tile)),
        begin(frame.tile_begin[index]),
        end(frame.tile_begin[index + 1]) {}

  float centre_x() const { return static_cast<float>(column * kTile) + 0.5f * kTile; }
  float centre_y() const { return static_cast<float>(row * kTile) + 0.5f * kTile; }
};

// Positions of a block's sixteen pixels from the tile's centre.
XRGS_INLINE Floats pixels_x(int block) {
  alignas(64) float x[16];
  for (int i = 0; i < 16; ++i) x[i] = static_cast<float>(4 * (block % 4) + i % 4) - 7.5f;
  return load(x);
}
XRGS_INLINE Floats pixels_y(int block) {
  alignas(64) float y[16];
  for (int i = 0; i < 16; ++i) y[i] = static_cast<float>(4 * (block / 4) + i / 4) - 7.5f;
  return load(y);
}

// Which Gaussian's record to bring in for each place, sixteen at a time; those past the end repeat
// the last.
XRGS_INLINE void load_sixteen(const Frame& frame, const Entry* entries, int count, Floats centre,
                              Floats (&out)[16]) {
  for (int i = 0; i < 16; ++i) {
    const std::uint32_t gaussian = entries[i < count ? i : count - 1].gaussian;
    out[i] = load(&frame.records[gaussian].x) - centre;
  }
}

// Ask for the records of the batch that begins at entry `first`.
XRGS_INLINE void prefetch_records(const Frame& frame, std::size_t first) {
  const std::size_t pairs = frame.entries.size();
  for (std::size_t i = first; i < pairs && i < first + kBatch; ++i)
    prefetch(&frame.records[frame.entries[i].gaussian]);
}

XRGS_INLINE Floats centre_of(const Tile& tile) {
  const float centre[16] = {tile.centre_x(), tile.centre_y()};
  return load(centre);
}

// What a pixel's alpha is cut at.
struct Cuts {
  Floats level_min;  // log2 of alpha_min
  Floats alpha_max, transmittance_min;

  explicit Cuts(const View& view)
      : level_min(splat(view.level_min)),
        alpha_max(splat(view.alpha_max)),
        transmittance_min(splat(view.transmittance_min)) {}
};

// Alpha of a Gaussian of the batch at sixteen pixels: capped, and zero below the cut.
XRGS_INLINE Floats alpha_at(const float* g, Floats x, Floats y, const Cuts& cuts) {
  const Floats dx = x - splat(g[kX]), dy = y - splat(g[kY]);
  const Floats u = fnma(splat(g[kS]), dy, splat(g[kP]) * dx), v = splat(g[kQ]) * dy;
  const Floats level = fnma(u, u, fnma(v, v, splat(g[kLevel])));
  return keep(cuts.level_min <= level, min_positive(exp2(level), cuts.alpha_max));
}

// One block's part of an image: `pixel` is its first pixel's index in row-major order, `width` and
// `height` (1 to 4) what of it lies inside the image.
struct BlockPlace {
  std::int64_t pixel;
  int width, height;

  BlockPlace(const Tile& tile, const View& view, int block) {
    const int x = tile.column * kTile + 4 * (block % 4), y = tile.row * kTile + 4 * (block / 4);
    pixel = std::int64_t{y} * view.width + x;
    width = view.width - x < 4 ? view.width - x : 4;
    height = view.height - y < 4 ? view.height - y : 4;
  }
  bool inside() const { return width > 0 && height > 0; }
  bool whole() const { return width == 4 && height == 4; }
};

// Copy a block of `channels` floats a pixel from rows `stride` floats apart to rows next to one
// another, or back; of a block that lies partly outside only what is inside.
template <int Channels>
XRGS_INLINE void copy_rows(const float* from, std::int64_t from_stride, float* to,
                           std::int64_t to_stride, const BlockPlace& place) {
  if (place.whole()) {
    for (int row = 0; row < 4; ++row)
      std::memcpy(to + row * to_stride, from + row * from_stride, 4 * Channels * sizeof(float));
    return;
  }
  for (int row = 0; row < place.height; ++row)
    for (int i = 0; i < Channels * place.width; ++i)
      to[row * to_stride + i] = from[row * from_stride + i];
}

}  // namespace XRGS_NS
}  // namespace xrgs
