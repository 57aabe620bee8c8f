// Compositing, backward: from the gradient of the image to pair_grads, one row for each (tile,
// Gaussian) pair (Eq. 16 to 18, whose names are used here).
//
// The batches of a tile are processed from the last to the first. For each block, a pass front to
// back repeats the forward pass, from the transmittance that the forward pass saved, and stores
// alpha and w. A pass back to front then computes R and sums over the block's pixels. The sums are
// products of 4x4 matrices: with g = dL/d(ln alpha) as a matrix, X = (1, x, x^2) in each column and
// Y = (1, y, y^2) in each row, both relative to the tile's centre, Y^T g X has the nine moments.
// The sums of w v_image are computed in the same way. At the end of the batch the moments are moved
// from the tile's centre to each Gaussian's mean (Eq. 18). This is not possible for absolute
// values, so with absgrad the derivatives with respect to the mean are summed pixel by pixel (Eq.
// 21).
#include "raster/stages.h"
#include "raster/tile_batch.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

// The gradients of a block's pixels. colors[c] holds those of column c: red, green, blue and 0 of
// each of its four pixels.
struct PixelGradients {
  alignas(64) float red[16], green[16], blue[16];
  alignas(64) float constant[16];  // v_alpha - background . v_image, the same for every Gaussian
  alignas(64) float colors[4][16];
};

// Alpha and w at the sixteen pixels of a block, for each Gaussian of its list.
using AlphasAndWeights = float[kBatchSize][32];

// Stores, for each column C of a block, (red, green, blue, 0) of its four pixels.
template <int C>
XRGS_INLINE void store_column(Floats red, Floats green, Floats blue, float* out) {
  const Floats low = select(mask_from_bits(0x2222), broadcast_column<C>(green),
                            select_or_zero(mask_from_bits(0x4444), broadcast_column<C>(blue)));
  store(out, select(mask_from_bits(0x1111), broadcast_column<C>(red), low));
}
XRGS_INLINE void store_by_column(Floats red, Floats green, Floats blue, float (&out)[4][16]) {
  store_column<0>(red, green, blue, out[0]);
  store_column<1>(red, green, blue, out[1]);
  store_column<2>(red, green, blue, out[2]);
  store_column<3>(red, green, blue, out[3]);
}

void load_pixel_gradients(const Tile& tile, const RenderConfig& config, const float* v_image,
                          const float* v_alpha, PixelGradients* pixel_gradients) {
  const float* background = config.background;
  // Copy all blocks before loading any, for the reason given in write_blocks.
  alignas(64) float colors[kBlocksPerTile][48] = {}, alphas[kBlocksPerTile][16] = {};
  for (int b = 0; b < kBlocksPerTile; ++b) {
    const BlockRegion region(tile, config, b);
    if (!region.overlaps_image()) continue;
    copy_block<3>(v_image + 3 * region.first_pixel, 3 * std::int64_t{config.width}, colors[b], 12,
                  region);
    copy_block<1>(v_alpha + region.first_pixel, config.width, alphas[b], 4, region);
  }
  for (int b = 0; b < kBlocksPerTile; ++b) {
    PixelGradients& out = pixel_gradients[b];
    Floats red, green, blue;
    load_triples(colors[b], red, green, blue);
    store(out.red, red);
    store(out.green, green);
    store(out.blue, blue);
    Floats constant = fnma(broadcast(background[0]), red, load(alphas[b]));
    constant = fnma(broadcast(background[1]), green, constant);
    store(out.constant, fnma(broadcast(background[2]), blue, constant));
    store_by_column(red, green, blue, out.colors);
  }
}

// Prefetches a row of pixels for load_pixel_gradients, if the tile and row exist.
XRGS_INLINE void prefetch_gradient_row(const Frame& frame, int tile_index, int row,
                                       const float* v_image, const float* v_alpha) {
  if (tile_index >= frame.config.tile_count()) return;
  const std::int64_t first = row_start(Tile(frame, tile_index), frame.config, row);
  if (first < 0) return;
  for (int i = 0; i < 3; ++i) prefetch(v_image + 3 * first + 16 * i);
  prefetch(v_alpha + first);
}

// Repeats the forward pass for a block's list: stores alpha (zero if not composited) and w.
XRGS_INLINE void recompute_alphas(const BatchRows& rows, const std::uint8_t* list, int count,
                                  int block, const AlphaThresholds& thresholds,
                                  const float* transmittance, AlphasAndWeights& out) {
  const Floats x = pixels_x(block), y = pixels_y(block);
  Floats running_T = load(transmittance);
  for (int at = 0; at < count; at += kUnroll) {
    Floats alpha[kUnroll];
    alphas_at(rows, list + at, x, y, thresholds, alpha);
    for (int i = 0; i < kUnroll; ++i) {
      const Floats alpha_T = alpha[i] * running_T;
      running_T = running_T - alpha_T;
      const Mask composited = thresholds.transmittance_min < running_T;
      store(out[at + i], select_or_zero(composited, alpha[i]));
      store(out[at + i] + 16, select_or_zero(composited, alpha_T));
    }
  }
}

// The factors of the moments, for each row and column i of a tile, as 4x4 matrices: of_column[i]
// has the columns 1, x, x^2, 0, and of_row[i] the rows 1, y, y^2, 0.
struct PixelPowers {
  alignas(64) float of_column[kTileSize][16], of_row[kTileSize][16];
  constexpr PixelPowers() : of_column(), of_row() {
    for (int i = 0; i < kTileSize; ++i) {
      const float at = static_cast<float>(i) - 7.5f;
      const float power[4] = {1.0f, at, at * at, 0.0f};
      for (int k = 0; k < 16; ++k) {
        of_column[i][k] = power[k % 4];
        of_row[i][k] = power[k / 4];
      }
    }
  }
};
constexpr PixelPowers kPixelPowers;

XRGS_INLINE void load_four(const float (*rows)[16], Floats (&out)[4]) {
  for (int i = 0; i < 4; ++i) out[i] = load(rows[i]);
}

// The sum over the columns c of column c of `a` times factors[c], row by row: a product of 4x4
// matrices.
XRGS_INLINE Floats times_columns(Floats a, const Floats (&factors)[4]) {
  const Floats even = fma(broadcast_column<2>(a), factors[2], broadcast_column<0>(a) * factors[0]);
  return fma(broadcast_column<3>(a), factors[3], fma(broadcast_column<1>(a), factors[1], even));
}

// Indices of the sums of absolute values in a moment row, in its last column, which has no moments.
constexpr int kAbsU = 3, kAbsV = 7;

// Processes a block's list back to front, and adds each Gaussian's sums over the block's pixels to
// its row of moments. As a 4x4 matrix, this row has the sum of g y^i x^j in row i < 3, column j <
// 3; with Absgrad, the last column of rows 0 and 1 has the sums of |g u| and |g (chol_yy v -
// chol_xy u)|. The sums of w v_image are added to its row of color_sums, pixel row by pixel row.
// `behind` is R of Eq. 17, for each pixel.
template <bool Absgrad>
XRGS_INLINE void accumulate_moments(const BatchRows& rows, const std::uint8_t* list, int count,
                                    int block, const AlphaThresholds& thresholds,
                                    const PixelGradients& v, const AlphasAndWeights& alphas,
                                    float* behind, BatchRows& moments, BatchRows& color_sums) {
  const Floats red = load(v.red), green = load(v.green), blue = load(v.blue);
  const Floats constant = load(v.constant);
  const Floats colors[4] = {load(v.colors[0]), load(v.colors[1]), load(v.colors[2]),
                            load(v.colors[3])};
  Floats powers_x[4], powers_y[4];
  load_four(kPixelPowers.of_column + 4 * (block % 4), powers_x);
  load_four(kPixelPowers.of_row + 4 * (block / 4), powers_y);
  const Floats x = pixels_x(block), y = pixels_y(block);  // used with Absgrad only
  Floats r = load(behind);
  for (int at = (count - 1) / kUnroll * kUnroll; at >= 0; at -= kUnroll) {
    const float* g[kUnroll];
    Floats weight[kUnroll], gradient[kUnroll];
    for (int i = kUnroll - 1; i >= 0; --i) {
      g[i] = rows[list[at + i]];
      const Floats alpha = load(alphas[at + i]);
      weight[i] = load(alphas[at + i] + 16);
      const Floats color_gradient =
          fma(broadcast(g[i][kRed]), red,
              fma(broadcast(g[i][kGreen]), green, fma(broadcast(g[i][kBlue]), blue, constant)));
      const Floats difference = color_gradient - r;
      r = fma(alpha, difference, r);
      // An alpha capped at alpha_max has no gradient.
      gradient[i] = multiply_where(alpha < thresholds.alpha_max, weight[i], difference);
    }
    Floats by_row[kUnroll], even[kUnroll], odd[kUnroll], color[kUnroll];
    for (int i = 0; i < kUnroll; ++i) by_row[i] = times_columns(gradient[i], powers_x);
    for (int i = 0; i < kUnroll; ++i) {
      even[i] = fma(broadcast_row<0>(by_row[i]), powers_y[0], load(moments[list[at + i]]));
      odd[i] = broadcast_row<1>(by_row[i]) * powers_y[1];
      even[i] = fma(broadcast_row<2>(by_row[i]), powers_y[2], even[i]);
      odd[i] = fma(broadcast_row<3>(by_row[i]), powers_y[3], odd[i]);
      color[i] = times_columns(weight[i], colors) + load(color_sums[list[at + i]]);
    }
    for (int i = 0; i < kUnroll; ++i) {
      store(moments[list[at + i]], even[i] + odd[i]);
      store(color_sums[list[at + i]], color[i]);
    }
    if constexpr (Absgrad) {
      for (int i = 0; i < kUnroll; ++i) {
        float* sums = moments[list[at + i]];
        const ScaledOffset d(g[i], x, y);
        const Floats by_y = fnma(broadcast(g[i][kCholXY]), d.u, broadcast(g[i][kCholYY]) * d.v);
        sums[kAbsU] += sum_lanes(abs(gradient[i] * d.u));
        sums[kAbsV] += sum_lanes(abs(gradient[i] * by_y));
      }
    }
  }
  store(behind, r);
}

// Computes the first six columns of pair_grads from the moments m about the tile's centre, for
// sixteen Gaussians. u is a linear function of the position, so its moments are linear combinations
// of those of x and y. Where g is large u is small, also at the tile's centre, so little cancels.
XRGS_INLINE void move_moments(const Floats (&fields)[16], const Floats (&m)[16],
                              Floats (&out)[16]) {
  const Floats mean_y = fields[kY], chol_xx = fields[kCholXX], chol_xy = fields[kCholXY];
  const Floats u_centre = fnma(chol_xx, fields[kX], chol_xy * mean_y);
  const Floats g = m[0], gx = m[1], gxx = m[2], gy = m[4], gxy = m[5], gyy = m[8];
  const auto times_u = [&](Floats of_1, Floats of_x, Floats of_y) {
    return fma(u_centre, of_1, fnma(chol_xy, of_y, chol_xx * of_x));
  };
  const Floats g_u = times_u(g, gx, gy);
  const Floats g_ux = times_u(gx, gxx, gxy), g_uy = times_u(gy, gxy, gyy);
  const Floats g_dy = fnma(mean_y, g, gy);
  // chol_* is scaled for base 2: u here is u of Eq. 8 times sqrt(log2(e)).
  const Floats to_base_e = broadcast(0.832554611f);
  out[kGrad] = g;
  out[kGradU] = to_base_e * g_u;
  out[kGradDy] = g_dy;
  out[kGradUU] = broadcast(0.693147181f) * times_u(g_u, g_ux, g_uy);
  out[kGradUDy] = to_base_e * fnma(mean_y, g_u, g_uy);
  out[kGradDyDy] = fnma(mean_y, gy + g_dy, gyy);
}

// Writes the pair_grads of a batch, from its moments about the tile's centre.
void write_pair_grads(const BatchRows& rows, const BatchRows& moments, const BatchRows& color_sums,
                      const TileEntry* entries, int count, float* pair_grads) {
  const Mask last_row = mask_from_bits(0xf000);
  for (int at = 0; at < count; at += 16) {
    Floats fields[16], m[16], out[16];
    load_fields(rows, at, fields);
    for (int i = 0; i < 16; ++i)
      m[i] = select(last_row, sum_rows(load(color_sums[at + i])), load(moments[at + i]));
    transpose(m);
    move_moments(fields, m, out);
    out[kGradRed] = m[12];
    out[kGradGreen] = m[13];
    out[kGradBlue] = m[14];
    // ln alpha = ln 2 (log2_opacity - u^2 - v^2), and the derivatives by the mean are du/dx =
    // -chol_xx, du/dy = chol_xy and dv/dy = -chol_yy.
    const Floats two_ln2 = broadcast(2.0f * 0.693147181f);
    out[kAbsGradX] = two_ln2 * fields[kCholXX] * m[kAbsU];
    out[kAbsGradY] = two_ln2 * m[kAbsV];
    for (int i = kPairGradFields; i < 16; ++i) out[i] = broadcast(0.0f);
    transpose(out);
    for (int i = 0; i < 16 && at + i < count; ++i)
      stream(pair_grads + std::size_t{entries[at + i].pair} * kPairGradStride, out[i]);
  }
}

// Loads a batch and sets its sums to zero.
void load_batch(const Frame& frame, const Tile& tile, const TileEntry* entries, int count,
                BatchRows& rows, BatchRows& moments, BatchRows& color_sums) {
  const Floats centre = centre_of(tile);
  for (int at = 0; at < count; at += 16) {
    const int lanes = count - at < 16 ? count - at : 16;
    load_projected(frame, entries + at, lanes, centre, rows, at);
    for (int i = 0; i < 16; ++i) {
      store(moments[at + i], broadcast(0.0f));
      store(color_sums[at + i], broadcast(0.0f));
    }
  }
}

// The first entry of a tile's last composited batch; past all entries if there is no such tile.
std::size_t last_batch(const Frame& frame, int tile) {
  if (tile >= frame.config.tile_count()) return frame.entries.size();
  const auto index = static_cast<std::size_t>(tile);
  const std::uint32_t batches = frame.composited_batches[index];
  return frame.tile_offsets[index] + (batches > 0 ? batches - 1 : 0) * std::size_t{kBatchSize};
}

template <bool Absgrad>
void backward_tile(const Frame& frame, int tile_index, const float* v_image, const float* v_alpha,
                   float* pair_grads) {
  const RenderConfig& config = frame.config;
  const Tile tile(frame, tile_index);
  if (tile.begin == tile.end) return;
  const AlphaThresholds thresholds(config);
  alignas(64) BatchRows rows, moments, color_sums;
  alignas(64) AlphasAndWeights alphas;
  set_transparent_row(rows);
  store(moments[kBatchSize], broadcast(0.0f));
  store(color_sums[kBatchSize], broadcast(0.0f));
  alignas(64) float behind[kBlocksPerTile][16] = {};
  PixelGradients pixel_gradients[kBlocksPerTile];
  load_pixel_gradients(tile, config, v_image, v_alpha, pixel_gradients);
  const std::uint32_t batches = (tile.end - tile.begin + kBatchSize - 1) / kBatchSize;
  const std::uint32_t composited = frame.composited_batches[tile.index];
  const TileEntry* entries = frame.entries.data() + tile.begin;
  // Batches that the forward pass skipped, because every pixel was saturated, have no gradient.
  for (std::uint32_t n = composited * kBatchSize; composited < batches && n < tile.end - tile.begin;
       ++n)
    stream(pair_grads + std::size_t{entries[n].pair} * kPairGradStride, broadcast(0.0f));
  const std::size_t next_tile = last_batch(frame, tile_index + 1);
  for (std::uint32_t n = composited; n-- > 0;) {
    const std::uint32_t at = n * kBatchSize, remaining = tile.end - tile.begin - at;
    const int count = remaining < kBatchSize ? static_cast<int>(remaining) : kBatchSize;
    const SavedBatch& batch = frame.batches[frame.batch_offsets[tile.index] + n];
    load_batch(frame, tile, entries + at, count, rows, moments, color_sums);
    for (int b = 0; b < kBlocksPerTile; ++b) {
      // The next batch is the one in front of this batch, or the last batch of the next tile.
      prefetch_part(frame, n > 0 ? tile.begin + at - kBatchSize : next_tile, b);
      if (n == 0) prefetch_gradient_row(frame, tile_index + 1, b, v_image, v_alpha);
      if (b + kBlocksAhead < kBlocksPerTile) {
        prefetch(batch.transmittance[b + kBlocksAhead]);
        prefetch(batch.lists[b + kBlocksAhead]);
      }
      const int listed = batch.counts[b];
      if (listed == 0) continue;
      recompute_alphas(rows, batch.lists[b], listed, b, thresholds, batch.transmittance[b], alphas);
      accumulate_moments<Absgrad>(rows, batch.lists[b], listed, b, thresholds, pixel_gradients[b],
                                  alphas, behind[b], moments, color_sums);
    }
    write_pair_grads(rows, moments, color_sums, entries + at, count, pair_grads);
  }
  stream_fence();
}

}  // namespace

void composite_backward(const Frame& frame, int tile, const float* v_image, const float* v_alpha,
                        float* pair_grads) {
  if (frame.config.absgrad)
    backward_tile<true>(frame, tile, v_image, v_alpha, pair_grads);
  else
    backward_tile<false>(frame, tile, v_image, v_alpha, pair_grads);
}

}  // namespace XRGS_NS
}  // namespace xrgs
