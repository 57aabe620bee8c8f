// Compositing, forward: blends a tile's list of Gaussians front to back into sixteen blocks of 4x4
// pixels (Eq. 8 and 14). With the culling options off, every block processes the whole list.
#include "raster/cutoff_ellipse.h"
#include "raster/stages.h"
#include "raster/tile_batch.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

constexpr int kCheckEvery = 8;  // Gaussians between two tests for a saturated block
static_assert(kCheckEvery % kUnroll == 0, "a block is tested after whole groups of Gaussians");

// The pixels of a block while it is composited.
struct BlockState {
  alignas(64) float running_T[16];  // the product of 1 - alpha of all Gaussians so far
  alignas(64) float final_T[16];    // that of the composited Gaussians: the transmittance
  alignas(64) float red[16], green[16], blue[16];
};

// For each byte, the positions of its set bits, lowest first, one in each byte of the result.
struct BitPositions {
  std::uint64_t of[256];
  constexpr BitPositions() : of() {
    for (unsigned byte = 0; byte < 256; ++byte) {
      std::uint64_t positions = 0;
      unsigned count = 0;
      for (unsigned bit = 0; bit < 8; ++bit)
        if ((byte >> bit & 1u) != 0) positions |= static_cast<std::uint64_t>(bit) << (8 * count++);
      of[byte] = positions;
    }
  }
};
constexpr BitPositions kBitPositions;

// Writes the positions of the set bits among the first `count`, and returns their number.
XRGS_INLINE int list_set_bits(const std::uint16_t* bits, int count, std::uint8_t* list) {
  int n = 0;
  for (int i = 0; i < count; i += 8) {
    const unsigned byte = bits[i / 16] >> (i % 16) & 255u;
    const std::uint64_t positions =
        kBitPositions.of[byte] + static_cast<std::uint64_t>(i) * 0x0101010101010101u;
    // Bytes past the end of the list are overwritten by the next eight, or never read.
    std::memcpy(list + n, &positions, 8);
    n += __builtin_popcount(byte);
  }
  return n;
}

// Pads a list of `count` entries to a multiple of kUnroll with the transparent row.
XRGS_INLINE void fill_up(std::uint8_t* list, int count) {
  for (int i = count; i % kUnroll != 0; ++i) list[i] = kBatchSize;
}

// Bit i % 16 of hits[block][i / 16]: the cutoff ellipse of Gaussian i of the batch overlaps the
// block.
using BlockHits = std::uint16_t[kBlocksPerTile][kBatchSize / 16];

// Loads a batch and finds the blocks that each of its Gaussians overlaps.
void load_and_cull_batch(const Frame& frame, const Tile& tile, const TileEntry* entries, int count,
                         BatchRows& rows, BlockHits& hits) {
  const Floats centre = centre_of(tile);
  for (int at = 0; at < count; at += 16) {
    const int lanes = count - at < 16 ? count - at : 16;
    Floats fields[16];
    load_projected(frame, entries + at, lanes, centre, rows, at);
    load_fields(rows, at, fields);
    const CutoffEllipse e = cutoff_ellipse(fields);
    const std::uint32_t existing = (1u << lanes) - 1u;
    for (int row = 0; row < 4; ++row) {
      const float top = static_cast<float>(4 * row) - 7.5f;
      Floats left, right;
      const Mask overlaps_rows =
          strip_extent(e, broadcast(top), broadcast(top + 3.0f), left, right) &
          mask_from_bits(existing);
      for (int column = 0; column < 4; ++column) {
        const float first = static_cast<float>(4 * column) - 7.5f;
        const Mask hit =
            overlaps_rows & (left <= broadcast(first + 3.0f)) & (broadcast(first) <= right);
        hits[4 * row + column][at / 16] = static_cast<std::uint16_t>(to_bits(hit));
      }
    }
  }
}

// Marks every Gaussian of the batch as overlapping every block.
void hit_all_blocks(int count, BlockHits& hits) {
  for (int at = 0; at < count; at += 16) {
    const int lanes = count - at < 16 ? count - at : 16;
    for (auto& block : hits) block[at / 16] = static_cast<std::uint16_t>((1u << lanes) - 1u);
  }
}

// Composites a block's list. Returns the number of Gaussians that were evaluated: all of them or,
// with StopWhenSaturated, those up to the test that found every pixel saturated.
template <bool StopWhenSaturated>
int composite_block(const BatchRows& rows, const std::uint8_t* list, int count, int block_index,
                    const AlphaThresholds& thresholds, BlockState& block) {
  const Floats x = pixels_x(block_index), y = pixels_y(block_index);
  Floats running_T = load(block.running_T), final_T = load(block.final_T);
  Floats red = load(block.red), green = load(block.green), blue = load(block.blue);
  int at = 0;
  while (at < count) {
    Floats alpha[kUnroll];
    alphas_at(rows, list + at, x, y, thresholds, alpha);
    Mask composited;
    for (int i = 0; i < kUnroll; ++i) {
      const float* g = rows[list[at + i]];
      const Floats alpha_T = alpha[i] * running_T;
      running_T = running_T - alpha_T;
      composited = thresholds.transmittance_min < running_T;
      const Floats weight = select_or_zero(composited, alpha_T);
      red = fma(weight, broadcast(g[kRed]), red);
      green = fma(weight, broadcast(g[kGreen]), green);
      blue = fma(weight, broadcast(g[kBlue]), blue);
      final_T = select(composited, running_T, final_T);
    }
    at += kUnroll;
    if (at % kCheckEvery == 0 && StopWhenSaturated && !any(composited)) break;
  }
  if (at > count) at = count;
  store(block.running_T, running_T);
  store(block.final_T, final_T);
  store(block.red, red);
  store(block.green, green);
  store(block.blue, blue);
  return at;
}

// Initialises the blocks and returns a bit for each one that overlaps the image. Pixels outside the
// image start saturated.
std::uint32_t init_blocks(const Tile& tile, const RenderConfig& config, BlockState* blocks) {
  std::uint32_t active_blocks = 0;
  for (int b = 0; b < kBlocksPerTile; ++b) {
    BlockState& block = blocks[b];
    for (int i = 0; i < 16; ++i) {
      const int x = tile.column * kTileSize + 4 * (b % 4) + i % 4;
      const int y = tile.row * kTileSize + 4 * (b / 4) + i / 4;
      const bool inside = x < config.width && y < config.height;
      block.running_T[i] = inside ? 1.0f : 0.0f;
      block.final_T[i] = 1.0f;
      block.red[i] = block.green[i] = block.blue[i] = 0.0f;
      if (inside) active_blocks |= 1u << b;
    }
  }
  return active_blocks;
}

// Prefetches a row of pixels for write_blocks, if it is inside the image.
XRGS_INLINE void prefetch_image_row(const Tile& tile, const RenderConfig& config, int row,
                                    const float* image, const float* alpha) {
  const std::int64_t first = row_start(tile, config, row);
  if (first < 0) return;
  for (int i = 0; i < 3; ++i) prefetch_to_write(image + 3 * first + 16 * i);
  prefetch_to_write(alpha + first);
}

// Writes colour over the background, and alpha = 1 - T (Eq. 15).
void write_blocks(const Tile& tile, const RenderConfig& config, const BlockState* blocks,
                  float* image, float* alpha) {
  const float* background = config.background;
  // Store all blocks before copying any: loading bytes that two stores have just written would wait
  // until both are in the cache.
  alignas(64) float colors[kBlocksPerTile][48], alphas[kBlocksPerTile][16];
  for (int b = 0; b < kBlocksPerTile; ++b) {
    const Floats final_T = load(blocks[b].final_T);
    store_triples(colors[b], fma(final_T, broadcast(background[0]), load(blocks[b].red)),
                  fma(final_T, broadcast(background[1]), load(blocks[b].green)),
                  fma(final_T, broadcast(background[2]), load(blocks[b].blue)));
    store(alphas[b], broadcast(1.0f) - final_T);
  }
  for (int b = 0; b < kBlocksPerTile; ++b) {
    const BlockRegion region(tile, config, b);
    if (!region.overlaps_image()) continue;
    copy_block<3>(colors[b], 12, image + 3 * region.first_pixel, 3 * std::int64_t{config.width},
                  region);
    copy_block<1>(alphas[b], 4, alpha + region.first_pixel, config.width, region);
  }
}

}  // namespace

void composite(Frame& frame, int tile_index, float* image, float* alpha) {
  const RenderConfig& config = frame.config;
  const Tile tile(frame, tile_index);
  const AlphaThresholds thresholds(config);
  const bool stop = config.culling.saturated;
  BlockState blocks[kBlocksPerTile];
  alignas(64) BatchRows rows;
  set_transparent_row(rows);
  std::uint32_t active_blocks = init_blocks(tile, config, blocks);
  std::int64_t evaluated_blocks = 0;
  SavedBatch* batch = frame.batches.data() + frame.batch_offsets[tile.index];
  std::uint32_t batches = 0;
  for (std::uint32_t at = tile.begin; at < tile.end && active_blocks != 0;
       at += kBatchSize, ++batch, ++batches) {
    const int count = tile.end - at < kBatchSize ? static_cast<int>(tile.end - at) : kBatchSize;
    const TileEntry* entries = frame.entries.data() + at;
    BlockHits hits;
    load_and_cull_batch(frame, tile, entries, count, rows, hits);
    if (!config.culling.blocks) hit_all_blocks(count, hits);
    for (int b = 0; b < kBlocksPerTile; ++b) {
      prefetch_part(frame, at + static_cast<std::uint32_t>(count), b);  // of this or the next tile
      if (batches == 0) prefetch_image_row(tile, config, b, image, alpha);
      if (b + kBlocksAhead < kBlocksPerTile) {
        prefetch_to_write(batch->transmittance[b + kBlocksAhead]);
        prefetch_to_write(batch->lists[b + kBlocksAhead]);
      }
      batch->counts[b] = 0;
      if ((active_blocks >> b & 1u) == 0) continue;
      store(batch->transmittance[b], load(blocks[b].running_T));
      const int listed = list_set_bits(hits[b], count, batch->lists[b]);
      fill_up(batch->lists[b], listed);
      const int evaluated =
          stop ? composite_block<true>(rows, batch->lists[b], listed, b, thresholds, blocks[b])
               : composite_block<false>(rows, batch->lists[b], listed, b, thresholds, blocks[b]);
      batch->counts[b] = static_cast<std::uint8_t>(evaluated);
      evaluated_blocks += evaluated;
      if (stop && !any(thresholds.transmittance_min < load(blocks[b].running_T)))
        active_blocks &= ~(1u << b);
    }
  }
  frame.composited_batches[tile.index] = batches;
  frame.tile_evaluations[tile.index] = 16 * evaluated_blocks;
  write_blocks(tile, config, blocks, image, alpha);
}

}  // namespace XRGS_NS
}  // namespace xrgs
