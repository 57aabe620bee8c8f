// A batch of a tile's Gaussians, brought near: their records side by side, the origin of x and y
// moved to the tile's centre.
#pragma once

#include "raster/frame.h"
#include "simd.h"

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

XRGS_INLINE Floats centre_of(const Tile& tile) {
  const float centre[16] = {tile.centre_x(), tile.centre_y()};
  return load(centre);
}

}  // namespace XRGS_NS
}  // namespace xrgs
