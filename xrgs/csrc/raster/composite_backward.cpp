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
// the T it left at the batch's start, noting alpha and w; then back to front for R, summing over
// the block's pixels as 4x4 matrices: with g a matrix, X = (1, x, x^2) in each column and
// Y = (1, y, y^2) in each row, both from the tile's centre, Y^T g X has the nine moments; with w,
// the sum of w v. At the batch's end the moments are moved to each Gaussian's mean. Absolute values
// have no moments: with absgrad the derivatives by the mean are taken pixel by pixel.
#include "raster/batch.h"
#include "raster/stages.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

// Pixel gradients of a block. The four `colors` have, for each column of its pixels, that column's
// red, green, blue and 0, row by row.
struct Incoming {
  alignas(64) float red[16], green[16], blue[16];
  alignas(64) float constant[16];  // v_alpha - background . v
  alignas(64) float colors[4][16];
};

// For each entry of a block's list: alpha and w.
using Notes = float[kBatch][32];

void load_incoming(const Tile& tile, const View& view, const float* image_gradient,
                   const float* alpha_gradient, Incoming* incoming) {
  const float* back = view.background;
  for (int b = 0; b < kBlocks; ++b) {
    const BlockPlace place(tile, view, b);
    if (!place.inside()) continue;
    Incoming& in = incoming[b];
    alignas(64) float colors[48] = {}, opaque[16] = {};
    copy_rows<3>(image_gradient + 3 * place.pixel, 3 * std::int64_t{view.width}, colors, 12, place);
    copy_rows<1>(alpha_gradient + place.pixel, view.width, opaque, 4, place);
    Floats red, green, blue;
    load_triples(colors, red, green, blue);
    store(in.red, red);
    store(in.green, green);
    store(in.blue, blue);
    Floats constant = fnma(splat(back[0]), red, load(opaque));
    constant = fnma(splat(back[1]), green, constant);
    store(in.constant, fnma(splat(back[2]), blue, constant));
    for (int row = 0; row < 4; ++row)
      for (int column = 0; column < 4; ++column) {
        const float* from = colors + 12 * row + 3 * column;
        const float part[4] = {from[0], from[1], from[2], 0.0f};
        std::memcpy(in.colors[column] + 4 * row, part, sizeof part);
      }
  }
}

// Front to back, as the forward pass went: alpha (zero where it was not composited) and w.
XRGS_INLINE void walk_forward(const Rows& rows, const std::uint8_t* list, int count, int block,
                              const Cuts& cuts, const float* before, Notes& notes) {
  const Floats x = pixels_x(block), y = pixels_y(block);
  Floats t = load(before);
  for (int at = 0; at < count; ++at) {
    const Floats alpha = alpha_at(rows[list[at]], x, y, cuts);
    const Floats gain = alpha * t;
    t = t - gain;
    const Mask kept = cuts.transmittance_min < t;
    store(notes[at], keep(kept, alpha));
    store(notes[at] + 16, keep(kept, gain));
  }
}

// The powers 1, x, x^2, 0 of the four columns' positions, the same in every row, and 1, y, y^2, 0
// of the four rows', each the whole of a row of its own.
struct Powers {
  Floats x[4], y[4];

  explicit Powers(int block) {
    for (int i = 0; i < 4; ++i) {
      const float at_x = static_cast<float>(4 * (block % 4) + i) - 7.5f;
      const float at_y = static_cast<float>(4 * (block / 4) + i) - 7.5f;
      alignas(64) float by_column[16], by_row[16];
      for (int k = 0; k < 4; ++k) {
        const float power_x[4] = {1.0f, at_x, at_x * at_x, 0.0f};
        const float power_y[4] = {1.0f, at_y, at_y * at_y, 0.0f};
        for (int j = 0; j < 4; ++j) {
          by_column[4 * k + j] = power_x[j];
          by_row[4 * k + j] = power_y[k];
        }
      }
      x[i] = load(by_column);
      y[i] = load(by_row);
    }
  }
};

// Sum over columns: of each row, its four values times the rows of the four factors.
XRGS_INLINE Floats times_columns(Floats a, const Floats (&factors)[4]) {
  const Floats even = fma(splat_column<2>(a), factors[2], splat_column<0>(a) * factors[0]);
  return fma(splat_column<3>(a), factors[3], fma(splat_column<1>(a), factors[1], even));
}

// Places of a row of sums that no moment needs.
constexpr int kAbsU = 3, kAbsV = 7;

// Back to front: each entry's sums over the block's pixels are added to its row of sums, which has
// in row i < 3, column j < 3 the sum of g y^i x^j, and in row 3 that of w v; with Absolute in the
// last column of rows 0 and 1 those of |g u| and |g (q v - s u)|.
template <bool Absolute>
XRGS_INLINE void walk_back(const Rows& rows, const std::uint8_t* list, int count, int block,
                           const Cuts& cuts, const Incoming& in, const Notes& notes, float* behind,
                           Rows& sums) {
  const Floats red = load(in.red), green = load(in.green), blue = load(in.blue);
  const Floats constant = load(in.constant);
  const Floats colors[4] = {load(in.colors[0]), load(in.colors[1]), load(in.colors[2]),
                            load(in.colors[3])};
  const Powers powers(block);
  const Floats x = pixels_x(block), y = pixels_y(block);  // unused unless Absolute
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
    const Floats by_row = times_columns(gradient, powers.x);
    float* place = sums[list[at]];
    Floats even = fma(splat_row<0>(by_row), powers.y[0], load(place));
    Floats odd = splat_row<1>(by_row) * powers.y[1];
    even = fma(splat_row<2>(by_row), powers.y[2], even);
    odd = fma(splat_row<3>(by_row), powers.y[3], odd);
    store(place, add_last_row(even + odd, sum_rows(times_columns(weight, colors))));
    if constexpr (Absolute) {
      const Floats dx = x - splat(g[kX]), dy = y - splat(g[kY]);
      const Floats u = fnma(splat(g[kS]), dy, splat(g[kP]) * dx), v = splat(g[kQ]) * dy;
      place[kAbsU] += sum(abs(gradient * u));
      place[kAbsV] += sum(abs(gradient * fnma(splat(g[kS]), u, splat(g[kQ]) * v)));
    }
  }
  store(behind, r);
}

// From sums about the tile's centre to sums about the Gaussians' means, into their slots.
void write_slots(const Rows& rows, const Rows& sums, const Entry* entries, int count,
                 float* slots) {
  for (int at = 0; at < count; at += 16) {
    Floats means[16], m[16], out[16];
    for (int i = 0; i < 16; ++i) {
      means[i] = load(rows[at + i]);
      m[i] = load(sums[at + i]);
    }
    transpose(means);
    transpose(m);
    const Floats a = means[kX], b = means[kY];
    const Floats g = m[0], gx = m[1], gxx = m[2], gy = m[4], gxy = m[5], gyy = m[8];
    const Floats to_x = fnma(a, g, gx), to_y = fnma(b, g, gy);
    out[kG] = g;
    out[kGx] = to_x;
    out[kGy] = to_y;
    out[kGxx] = fnma(a, gx + to_x, gxx);
    out[kGxy] = fnma(a, gy, fnma(b, to_x, gxy));
    out[kGyy] = fnma(b, gy + to_y, gyy);
    out[kWr] = m[12];
    out[kWg] = m[13];
    out[kWb] = m[14];
    // ln alpha = ln 2 (level - u^2 - v^2), and du/dx = -p, du/dy = s, dv/dy = -q by the mean.
    const Floats twice = splat(2.0f * 0.693147181f);
    out[kAbsX] = twice * means[kP] * m[kAbsU];
    out[kAbsY] = twice * m[kAbsV];
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

template <bool Absolute>
void backward_tile(const Frame& frame, int index, const float* image_gradient,
                   const float* alpha_gradient, float* slots) {
  const View& view = frame.view;
  const Tile tile(frame, index);
  if (tile.begin == tile.end) return;
  const Cuts cuts(view);
  alignas(64) Rows rows, sums;
  alignas(64) Notes notes;
  alignas(64) float behind[kBlocks][16] = {};
  Incoming incoming[kBlocks];
  load_incoming(tile, view, image_gradient, alpha_gradient, incoming);
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
    // The batch that comes next: the one before, or about one of the next tile.
    prefetch_records(frame, n > 0 ? tile.begin + at - kBatch : tile.end);
    for (int b = 0; b < kBlocks; ++b) {
      const int listed = batch.counts[b];
      if (listed == 0) continue;
      walk_forward(rows, batch.lists[b], listed, b, cuts, batch.before[b], notes);
      walk_back<Absolute>(rows, batch.lists[b], listed, b, cuts, incoming[b], notes, behind[b],
                          sums);
    }
    write_slots(rows, sums, entries + at, count, slots);
  }
  stream_fence();
}

}  // namespace

void composite_backward(const Frame& frame, int tile, const float* image_gradient,
                        const float* alpha_gradient, float* slots) {
  if (frame.view.absgrad)
    backward_tile<true>(frame, tile, image_gradient, alpha_gradient, slots);
  else
    backward_tile<false>(frame, tile, image_gradient, alpha_gradient, slots);
}

}  // namespace XRGS_NS
}  // namespace xrgs
