// A batch of at most kBatchSize of a tile's Gaussians, copied to contiguous memory, with the tile's
// centre as the origin of x and y.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>

#include "raster/frame.h"
#include "simd/simd.h"

namespace xrgs {
namespace XRGS_NS {

// The Gaussians of a batch, one row each, in the layout of ProjectedGaussian. The last row is a
// transparent Gaussian, with which lists are padded to a multiple of kUnroll.
using BatchRows = float[kBatchSize + 1][16];
enum BatchField { kX, kY, kCholXX, kCholXY, kCholYY, kLog2Opacity, kRed, kGreen, kBlue };

struct Tile {
  int column, row;
  std::size_t index;
  std::uint32_t begin, end;  // of its list in frame.entries

  Tile(const Frame& frame, int tile)
      : column(tile % frame.config.tile_columns()),
        row(tile / frame.config.tile_columns()),
        index(static_cast<std::size_t>(tile)),
        begin(frame.tile_offsets[index]),
        end(frame.tile_offsets[index + 1]) {}

  float centre_x() const { return static_cast<float>(column * kTileSize) + 0.5f * kTileSize; }
  float centre_y() const { return static_cast<float>(row * kTileSize) + 0.5f * kTileSize; }
};

// The positions of the sixteen pixel centres of a block, relative to the tile's centre.
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

// Loads the projected Gaussians of `count` (1 to 16) entries into rows first..first+15 of a batch,
// with `centre` subtracted; rows past the end are copies of the last row.
XRGS_INLINE void load_projected(const Frame& frame, const TileEntry* entries, int count,
                                Floats centre, BatchRows& rows, int first) {
  for (int i = 0; i < 16; ++i) {
    const std::uint32_t gaussian = entries[i < count ? i : count - 1].gaussian;
    store(rows[first + i], load(&frame.projected[gaussian].mean2d_x) - centre);
  }
}

// The fields of the Gaussians in rows first..first+15 of a batch: out[i] is the i-th of each.
XRGS_INLINE void load_fields(const BatchRows& rows, int first, Floats (&out)[16]) {
  for (int i = 0; i < 16; ++i) out[i] = load(rows[first + i]);
  transpose(out);
}

// Prefetches one of kBlocksPerTile parts of the projected Gaussians of the batch that begins at
// entry `first`. Each block prefetches a part, since a processor has too few buffers for the whole
// batch.
XRGS_INLINE void prefetch_part(const Frame& frame, std::size_t first, int part) {
  constexpr std::size_t kPart = kBatchSize / kBlocksPerTile;
  const std::size_t pairs = frame.entries.size(),
                    begin = first + static_cast<std::size_t>(part) * kPart;
  for (std::size_t i = begin; i < pairs && i < begin + kPart; ++i)
    prefetch(&frame.projected[frame.entries[i].gaussian]);
}

// Number of blocks between the prefetch of a block's saved data in the frame and its use.
constexpr int kBlocksAhead = 2;

// The index of the first pixel of a row of a tile, or -1 if the row is below the image.
XRGS_INLINE std::int64_t row_start(const Tile& tile, const RenderConfig& config, int row) {
  const int y = tile.row * kTileSize + row;
  return y < config.height ? std::int64_t{y} * config.width + tile.column * kTileSize : -1;
}

// The tile's centre in the fields of the mean, zero in all others.
XRGS_INLINE Floats centre_of(const Tile& tile) {
  const float centre[16] = {tile.centre_x(), tile.centre_y()};
  return load(centre);
}

// Makes the last row of a batch transparent.
XRGS_INLINE void set_transparent_row(BatchRows& rows) {
  const float row[16] = {0, 0, 0, 0, 0, -1e30f};
  store(rows[kBatchSize], load(row));
}

// The thresholds of compositing, in all lanes.
struct AlphaThresholds {
  Floats log2_alpha_min;
  Floats alpha_max, transmittance_min;

  explicit AlphaThresholds(const RenderConfig& config)
      : log2_alpha_min(broadcast(config.log2_alpha_min)),
        alpha_max(broadcast(config.alpha_max)),
        transmittance_min(broadcast(config.transmittance_min)) {}
};

// Number of Gaussians whose alphas are computed together, to hide the latency of the operations.
// Four would be faster for long lists, but lists are padded to a multiple, and those of small
// images have only about fifteen Gaussians.
constexpr int kUnroll = 2;

// u and v of a Gaussian g of the batch at sixteen pixels (Eq. 8).
struct ScaledOffset {
  Floats u, v;
  ScaledOffset(const float* g, Floats x, Floats y) {
    const Floats dx = x - broadcast(g[kX]), dy = y - broadcast(g[kY]);
    u = fnma(broadcast(g[kCholXY]), dy, broadcast(g[kCholXX]) * dx);
    v = broadcast(g[kCholYY]) * dy;
  }
};

// The alphas of kUnroll Gaussians of the batch at sixteen pixels (Eq. 8): capped at alpha_max, and
// zero below alpha_min.
XRGS_INLINE void alphas_at(const BatchRows& rows, const std::uint8_t* list, Floats x, Floats y,
                           const AlphaThresholds& thresholds, Floats (&alpha)[kUnroll]) {
  Floats log2_alpha[kUnroll];
  for (int i = 0; i < kUnroll; ++i) {
    const float* g = rows[list[i]];
    const ScaledOffset d(g, x, y);
    log2_alpha[i] = fnma(d.u, d.u, fnma(d.v, d.v, broadcast(g[kLog2Opacity])));
  }
  exp2(log2_alpha, alpha);
  for (int i = 0; i < kUnroll; ++i)
    alpha[i] = min_positive_where(thresholds.log2_alpha_min <= log2_alpha[i], alpha[i],
                                  thresholds.alpha_max);
}

// The part of an image that a 4x4 block covers: the index of its first pixel in row-major order,
// and the width and height (at most 4) that lie inside the image.
struct BlockRegion {
  std::int64_t first_pixel;
  int width, height;

  BlockRegion(const Tile& tile, const RenderConfig& config, int block) {
    const int x = tile.column * kTileSize + 4 * (block % 4);
    const int y = tile.row * kTileSize + 4 * (block / 4);
    first_pixel = std::int64_t{y} * config.width + x;
    width = config.width - x < 4 ? config.width - x : 4;
    height = config.height - y < 4 ? config.height - y : 4;
  }
  bool overlaps_image() const { return width > 0 && height > 0; }
  bool whole() const { return width == 4 && height == 4; }
};

// Copies the part of a block inside the image, with `Channels` floats per pixel, between two arrays
// whose rows are from_stride and to_stride floats apart.
template <int Channels>
XRGS_INLINE void copy_block(const float* from, std::int64_t from_stride, float* to,
                            std::int64_t to_stride, const BlockRegion& region) {
  if (region.whole()) {
    for (int row = 0; row < 4; ++row)
      std::memcpy(to + row * to_stride, from + row * from_stride, 4 * Channels * sizeof(float));
    return;
  }
  for (int row = 0; row < region.height; ++row)
    for (int i = 0; i < Channels * region.width; ++i)
      to[row * to_stride + i] = from[row * from_stride + i];
}

}  // namespace XRGS_NS
}  // namespace xrgs
