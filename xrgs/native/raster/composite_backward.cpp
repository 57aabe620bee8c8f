// Compositing, backward: from the image's gradient to sums for each (tile, Gaussian) pair.
//
// With v the gradient of a pixel's colour, each Gaussian i of the pixel's list gives
//   G_i = color_i . v - background . v + v_alpha,    w_i = alpha_i T_i,
//   dL/d(ln alpha_i) = w_i (G_i - R_i),   R_i = (what lies behind i, as if seen through nothing),
//   R_{i-1} = R_i + alpha_i (G_i - R_i),
// since the image is sum of w_i color_i + (1 - sum of w_i) background and alpha is sum of w_i. Back
// to front, R needs no division by 1 - alpha, and never loses digits to subtraction.
//
// For each batch, last to first, and each block: walk the forward pass's list front to back from
// the T it left at the batch's start, noting alpha and w; then back to front for R; then sum over
// the block's pixels, one matrix product: (g, w) of 16 pixels times, for each pixel, 1, x, y, x^2,
// xy, y^2 from the tile's centre in even lanes and v in odd ones. At the batch's end the moments
// are moved from the tile's centre to each Gaussian's mean.
#include "raster/batch.h"
#include "raster/stages.h"
#include "vector_math.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

// Pixel gradients of a tile.
struct Incoming {
  alignas(64) float red[kBlocks][16], green[kBlocks][16], blue[kBlocks][16];
  alignas(64) float constant[kBlocks][16];  // v_alpha - background . v
  alignas(64) float factors[kBlocks][16][16];  // of each pixel, the product's row
};

// Two vectors for each entry of a block's list: alpha and w at first, then g and w, interleaved.
using Notes = float[kBatch][32];

void load_incoming(const Tile& tile, const View& view, const float* image_gradient,
                   const float* alpha_gradient, Incoming& in) {
  const float* back = view.background;
  for (int b = 0; b < kBlocks; ++b)
    for (int i = 0; i < 16; ++i) {
      const int x = tile.column * kTile + 4 * (b % 4) + i % 4;
      const int y = tile.row * kTile + 4 * (b / 4) + i / 4;
      float red = 0.0f, green = 0.0f, blue = 0.0f, alpha = 0.0f;
      if (x < view.width && y < view.height) {
        const std::int64_t pixel = std::int64_t{y} * view.width + x;
        red = image_gradient[3 * pixel];
        green = image_gradient[3 * pixel + 1];
        blue = image_gradient[3 * pixel + 2];
        alpha = alpha_gradient[pixel];
      }
      in.red[b][i] = red;
      in.green[b][i] = green;
      in.blue[b][i] = blue;
      in.constant[b][i] = alpha - (back[0] * red + back[1] * green + back[2] * blue);
      const float dx = static_cast<float>(4 * (b % 4) + i % 4) - 7.5f;
      const float dy = static_cast<float>(4 * (b / 4) + i / 4) - 7.5f;
      const float row[16] = {1.0f, red, dx, green, dy, blue, dx * dx, 0.0f, dx * dy, 0.0f, dy * dy};
      store(in.factors[b][i], load(row));
    }
}

struct Cuts {
  Floats alpha_min, alpha_max, transmittance_min;
};

// Front to back, as the forward pass went: alpha (zero where it was not composited) and w.
XRGS_INLINE void walk_forward(const Rows& rows, const std::uint8_t* list, int count, int block,
                              const Cuts& cuts, const float* before, Notes& notes) {
  const Floats x = pixels_x(block), y = pixels_y(block);
  Floats t = load(before);
  for (int at = 0; at < count; ++at) {
    const float* g = rows[list[at]];
    const Floats dx = x - splat(g[kX]), dy = y - splat(g[kY]);
    const Floats u = fnma(splat(g[kS]), dy, splat(g[kP]) * dx), v = splat(g[kQ]) * dy;
    Floats alpha = exp2(fnma(u, u, fnma(v, v, splat(g[kLevel]))));
    alpha = keep(cuts.alpha_min <= alpha, min(alpha, cuts.alpha_max));
    const Floats after = fnma(alpha, t, t);
    alpha = keep(cuts.transmittance_min < after, alpha);
    store(notes[at], alpha);
    store(notes[at] + 16, alpha * t);
    t = after;
  }
}

// Back to front: g and w, interleaved.
XRGS_INLINE void walk_back(const Rows& rows, const std::uint8_t* list, int count, int block,
                           const Cuts& cuts, const Incoming& in, float* behind, Notes& notes) {
  const Floats red = load(in.red[block]), green = load(in.green[block]);
  const Floats blue = load(in.blue[block]), constant = load(in.constant[block]);
  Floats r = load(behind);
  for (int at = count - 1; at >= 0; --at) {
    const float* g = rows[list[at]];
    const Floats alpha = load(notes[at]), weight = load(notes[at] + 16);
    const Floats color = fma(splat(g[kRed]), red,
                             fma(splat(g[kGreen]), green, fma(splat(g[kBlue]), blue, constant)));
    const Floats gain = color - r;
    r = fma(alpha, gain, r);
    // A capped alpha does not move with its Gaussian.
    const Floats gradient = keep(alpha < cuts.alpha_max, weight * gain);
    Floats low, high;
    interleave(gradient, weight, low, high);
    store(notes[at], low);
    store(notes[at] + 16, high);
  }
  store(behind, r);
}

// Add each entry's sums over the block's pixels to its row of sums.
XRGS_INLINE void sum_pixels(const std::uint8_t* list, int count, int block, const Incoming& in,
                            const Notes& notes, Rows& sums) {
  Floats factors[16];
  for (int i = 0; i < 16; ++i) factors[i] = load(in.factors[block][i]);
  for (int at = 0; at < count; ++at) {
    float* sum = sums[list[at]];
    Floats even = load(sum), odd = splat_pair(notes[at] + 2) * factors[1];
    even = fma(splat_pair(notes[at]), factors[0], even);
    for (int i = 2; i < 16; i += 2) {
      even = fma(splat_pair(notes[at] + 2 * i), factors[i], even);
      odd = fma(splat_pair(notes[at] + 2 * i + 2), factors[i + 1], odd);
    }
    store(sum, even + odd);
  }
}

// From sums about the tile's centre to sums about the Gaussians' means, into their slots.
void write_slots(const Rows& rows, const Rows& sums, const Entry* entries, int count, float* slots) {
  for (int at = 0; at < count; at += 16) {
    Floats means[16], m[16], out[16];
    for (int i = 0; i < 16; ++i) {
      means[i] = load(rows[at + i]);
      m[i] = load(sums[at + i]);
    }
    transpose(means);
    transpose(m);
    const Floats a = means[kX], b = means[kY];
    const Floats g = m[0], gx = m[2], gy = m[4], gxx = m[6], gxy = m[8], gyy = m[10];
    const Floats to_x = fnma(a, g, gx), to_y = fnma(b, g, gy);
    out[kG] = g;
    out[kGx] = to_x;
    out[kGy] = to_y;
    out[kGxx] = fnma(a, gx + to_x, gxx);
    out[kGxy] = fnma(a, gy, fnma(b, to_x, gxy));
    out[kGyy] = fnma(b, gy + to_y, gyy);
    out[kWr] = m[1];
    out[kWg] = m[3];
    out[kWb] = m[5];
    for (int i = kSlotFields; i < 16; ++i) out[i] = splat(0.0f);
    transpose(out);
    for (int i = 0; i < 16 && at + i < count; ++i)
      stream(slots + std::size_t{entries[at + i].slot} * kSlotSize, out[i]);
  }
}

// Bring in a batch and set its sums to zero.
void load_batch(const Frame& frame, const Tile& tile, const Entry* entries, int count, Rows& rows,
                Rows& sums) {
  const Floats centre = centre_of(tile);
  for (int at = 0; at < count; at += 16) {
    const int lanes = count - at < 16 ? count - at : 16;
    Floats fields[16];
    load_sixteen(frame, entries + at, lanes, centre, fields);
    for (int i = 0; i < 16; ++i) {
      store(rows[at + i], fields[i]);
      store(sums[at + i], splat(0.0f));
    }
  }
}

}  // namespace

void composite_backward(const Frame& frame, int index, const float* image_gradient,
                        const float* alpha_gradient, float* slots) {
  const View& view = frame.view;
  const Tile tile(frame, index);
  if (tile.begin == tile.end) return;
  const Cuts cuts{splat(view.alpha_min), splat(view.alpha_max), splat(view.transmittance_min)};
  alignas(64) Rows rows, sums;
  alignas(64) Notes notes;
  alignas(64) float behind[kBlocks][16] = {};
  Incoming in;
  load_incoming(tile, view, image_gradient, alpha_gradient, in);
  const std::uint32_t batches = (tile.end - tile.begin + kBatch - 1) / kBatch;
  const std::uint32_t done = frame.batches_done[tile.index];
  const Entry* entries = frame.entries.data() + tile.begin;
  for (std::uint32_t n = done * kBatch; done < batches && n < tile.end - tile.begin; ++n)
    stream(slots + std::size_t{entries[n].slot} * kSlotSize, splat(0.0f));
  for (std::uint32_t n = done; n-- > 0;) {
    const std::uint32_t at = n * kBatch, left = tile.end - tile.begin - at;
    const int count = left < kBatch ? static_cast<int>(left) : kBatch;
    const Batch& batch = frame.batches[frame.batch_begin[tile.index] + n];
    load_batch(frame, tile, entries + at, count, rows, sums);
    if (n > 0)
      for (std::uint32_t i = at - kBatch; i < at; ++i) prefetch(&frame.records[entries[i].gaussian]);
    for (int b = 0; b < kBlocks; ++b) {
      const int listed = batch.counts[b];
      if (listed == 0) continue;
      walk_forward(rows, batch.lists[b], listed, b, cuts, batch.before[b], notes);
      walk_back(rows, batch.lists[b], listed, b, cuts, in, behind[b], notes);
      sum_pixels(batch.lists[b], listed, b, in, notes, sums);
    }
    write_slots(rows, sums, entries + at, count, slots);
  }
  stream_fence();
}

}  // namespace XRGS_NS
}  // namespace xrgs
