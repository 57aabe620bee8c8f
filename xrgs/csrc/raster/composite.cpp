// Compositing, forward: a tile's list, front to back, into sixteen blocks of 4x4 pixels.
//
// Alpha = 2^(level - u^2 - v^2), capped at alpha_max and skipped below alpha_min; a pixel's colour
// gains alpha T color, and its transmittance T becomes T (1 - alpha), unless that is
// transmittance_min or less: then this Gaussian is not composited and the pixel is finished.
// T is never frozen: it only falls, so the test stays failed, and what was kept is a prefix.
//
// With the view's skips off, every block goes through the tile's list, and to its end.
#include "raster/batch.h"
#include "raster/ellipse.h"
#include "raster/stages.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

constexpr int kCheckEvery = 8;  // Gaussians between the tests whether a block is finished

struct Block {
  alignas(64) float t[16];     // what T falls to, kept or not
  alignas(64) float left[16];  // T behind the last Gaussian that was kept
  alignas(64) float red[16], green[16], blue[16];
};

// For each byte the places of its bits, one a byte, lowest first.
struct Places {
  std::uint64_t of[256];
  constexpr Places() : of() {
    for (unsigned byte = 0; byte < 256; ++byte) {
      std::uint64_t places = 0;
      unsigned count = 0;
      for (unsigned bit = 0; bit < 8; ++bit)
        if ((byte >> bit & 1u) != 0) places |= static_cast<std::uint64_t>(bit) << (8 * count++);
      of[byte] = places;
    }
  }
};
constexpr Places kPlaces;

// The list of a block: the places in the batch whose bits are set.
XRGS_INLINE int compact(const std::uint16_t* hits, int count, std::uint8_t* list) {
  int n = 0;
  for (int i = 0; i < count; i += 8) {
    const unsigned byte = hits[i / 16] >> (i % 16) & 255u;
    const std::uint64_t places =
        kPlaces.of[byte] + static_cast<std::uint64_t>(i) * 0x0101010101010101u;
    std::memcpy(list + n, &places, 8);  // past the list's end: overwritten by the next, or unread
    n += __builtin_popcount(byte);
  }
  return n;
}

// Bring in a batch, and note which blocks each of its Gaussians reaches: hits[block][place / 16].
void load_batch(const Frame& frame, const Tile& tile, const Entry* entries, int count, Rows& rows,
                std::uint16_t (&hits)[kBlocks][kBatch / 16]) {
  const Floats centre = centre_of(tile);
  for (int at = 0; at < count; at += 16) {
    const int lanes = count - at < 16 ? count - at : 16;
    Floats fields[16];
    load_sixteen(frame, entries + at, lanes, centre, fields);
    for (int i = 0; i < 16; ++i) store(rows[at + i], fields[i]);
    transpose(fields);
    const Ellipse e = ellipse_of(fields);
    const std::uint32_t inside = (1u << lanes) - 1u;
    for (int row = 0; row < 4; ++row) {
      const float top = static_cast<float>(4 * row) - 7.5f;
      Floats left, right;
      const Mask reached = span(e, splat(top), splat(top + 3.0f), left, right) & mask_of(inside);
      for (int column = 0; column < 4; ++column) {
        const float first = static_cast<float>(4 * column) - 7.5f;
        const Mask hit = reached & (left <= splat(first + 3.0f)) & (splat(first) <= right);
        hits[4 * row + column][at / 16] = static_cast<std::uint16_t>(bits(hit));
      }
    }
  }
}

// As if each Gaussian reached every block.
void hit_all(int count, std::uint16_t (&hits)[kBlocks][kBatch / 16]) {
  for (int at = 0; at < count; at += 16) {
    const int lanes = count - at < 16 ? count - at : 16;
    for (auto& block : hits) block[at / 16] = static_cast<std::uint16_t>((1u << lanes) - 1u);
  }
}

// Composite a block's list. Returns how far it went: to the end, or (with Stop) to where no pixel
// is left.
template <bool Stop>
int composite_block(const Rows& rows, const std::uint8_t* list, int count, int index,
                    const Cuts& cuts, Block& block) {
  const Floats x = pixels_x(index), y = pixels_y(index);
  Floats t = load(block.t), left = load(block.left);
  Floats red = load(block.red), green = load(block.green), blue = load(block.blue);
  int at = 0;
  while (at < count) {
    const float* g = rows[list[at]];
    const Floats alpha = alpha_at(g, x, y, cuts);
    const Floats gain = alpha * t;
    t = t - gain;
    const Mask kept = cuts.transmittance_min < t;
    const Floats weight = keep(kept, gain);
    red = fma(weight, splat(g[kRed]), red);
    green = fma(weight, splat(g[kGreen]), green);
    blue = fma(weight, splat(g[kBlue]), blue);
    left = select(kept, t, left);
    if (++at % kCheckEvery == 0 && Stop && !any(kept)) break;
  }
  store(block.t, t);
  store(block.left, left);
  store(block.red, red);
  store(block.green, green);
  store(block.blue, blue);
  return at;
}

// Blocks with all pixels outside the image start finished.
std::uint32_t start_blocks(const Tile& tile, const View& view, Block* blocks) {
  std::uint32_t alive = 0;
  for (int b = 0; b < kBlocks; ++b) {
    Block& block = blocks[b];
    for (int i = 0; i < 16; ++i) {
      const int x = tile.column * kTile + 4 * (b % 4) + i % 4;
      const int y = tile.row * kTile + 4 * (b / 4) + i / 4;
      const bool inside = x < view.width && y < view.height;
      block.t[i] = inside ? 1.0f : 0.0f;
      block.left[i] = 1.0f;
      block.red[i] = block.green[i] = block.blue[i] = 0.0f;
      if (inside) alive |= 1u << b;
    }
  }
  return alive;
}

void write_blocks(const Tile& tile, const View& view, const Block* blocks, float* image,
                  float* alpha) {
  const float* back = view.background;
  for (int b = 0; b < kBlocks; ++b) {
    const BlockPlace place(tile, view, b);
    if (!place.inside()) continue;
    const Floats left = load(blocks[b].left);
    alignas(64) float colors[48], opaque[16];
    store_triples(colors, fma(left, splat(back[0]), load(blocks[b].red)),
                  fma(left, splat(back[1]), load(blocks[b].green)),
                  fma(left, splat(back[2]), load(blocks[b].blue)));
    store(opaque, splat(1.0f) - left);
    copy_rows<3>(colors, 12, image + 3 * place.pixel, 3 * std::int64_t{view.width}, place);
    copy_rows<1>(opaque, 4, alpha + place.pixel, view.width, place);
  }
}

}  // namespace

void composite(Frame& frame, int index, float* image, float* alpha) {
  const View& view = frame.view;
  const Tile tile(frame, index);
  const Cuts cuts(view);
  const bool stop = view.skips.saturated;
  Block blocks[kBlocks];
  alignas(64) Rows rows;
  std::uint32_t alive = start_blocks(tile, view, blocks);
  std::int64_t entries_done = 0;
  Batch* batch = frame.batches.data() + frame.batch_begin[tile.index];
  std::uint32_t done = 0;
  for (std::uint32_t at = tile.begin; at < tile.end && alive != 0; at += kBatch, ++batch, ++done) {
    const int count = tile.end - at < kBatch ? static_cast<int>(tile.end - at) : kBatch;
    const Entry* entries = frame.entries.data() + at;
    std::uint16_t hits[kBlocks][kBatch / 16];
    load_batch(frame, tile, entries, count, rows, hits);
    if (!view.skips.blocks) hit_all(count, hits);
    prefetch_records(frame, at + kBatch);  // the next batch's, or the next tile's
    for (int b = 0; b < kBlocks; ++b) {
      batch->counts[b] = 0;
      if ((alive >> b & 1u) == 0) continue;
      store(batch->before[b], load(blocks[b].t));
      const int listed = compact(hits[b], count, batch->lists[b]);
      const int went =
          stop ? composite_block<true>(rows, batch->lists[b], listed, b, cuts, blocks[b])
               : composite_block<false>(rows, batch->lists[b], listed, b, cuts, blocks[b]);
      batch->counts[b] = static_cast<std::uint8_t>(went);
      entries_done += went;
      if (stop && !any(cuts.transmittance_min < load(blocks[b].t))) alive &= ~(1u << b);
    }
  }
  frame.batches_done[tile.index] = done;
  frame.tile_evaluations[tile.index] = 16 * entries_done;
  write_blocks(tile, view, blocks, image, alpha);
}

}  // namespace XRGS_NS
}  // namespace xrgs
