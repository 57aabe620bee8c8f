// Compositing, backward: from the gradient of the image to pair_grads, one row for each (tile,
// Gaussian) pair.
//
// With v_image the gradient of a pixel's colour and v_alpha that of its alpha, each Gaussian i of
// the pixel's list has (Eq. 16 and 17)
//   G_i = (color_i - background) . v_image + v_alpha,    w_i = alpha_i T_i,
//   dL/d(ln alpha_i) = w_i (G_i - R_i),    R_{i-1} = R_i + alpha_i (G_i - R_i),
// where R_i is what lies behind Gaussian i, divided by the transmittance in front of it. Computed
// back to front, R needs no division by 1 - alpha and loses no digits to cancellation.
//
// The batches of a tile are processed from the last to the first. For each block, a pass front to
// back repeats the forward pass from the transmittance that it saved, and stores alpha and w; a
// pass back to front then computes R and sums over the block's pixels. The sums are products of 4x4
// matrices: with g as a matrix, X = (1, x, x^2) in each column and Y = (1, y, y^2) in each row,
// both from the tile's centre, Y^T g X holds the nine moments; with w in the place of g, the sums
// of w v_image. At the end of the batch the moments are moved from the tile's centre to each
// Gaussian's mean (Eq. 18). Absolute values have no such moments, so with absgrad the derivatives
// by the mean are summed pixel by pixel (Eq. 21).
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

void load_pixel_gradients(const Tile& tile, const RenderConfig& config, const float* v_image,
                          const float* v_alpha, PixelGradients* pixel_gradients) {
  const float* background = config.background;
  for (int b = 0; b < kBlocksPerTile; ++b) {
    const BlockRegion region(tile, config, b);
    if (!region.overlaps_image()) continue;
    PixelGradients& out = pixel_gradients[b];
    alignas(64) float colors[48] = {}, alphas[16] = {};
    copy_block<3>(v_image + 3 * region.first_pixel, 3 * std::int64_t{config.width}, colors, 12,
                  region);
    copy_block<1>(v_alpha + region.first_pixel, config.width, alphas, 4, region);
    Floats red, green, blue;
    load_triples(colors, red, green, blue);
    store(out.red, red);
    store(out.green, green);
    store(out.blue, blue);
    Floats constant = fnma(broadcast(background[0]), red, load(alphas));
    constant = fnma(broadcast(background[1]), green, constant);
    store(out.constant, fnma(broadcast(background[2]), blue, constant));
    for (int row = 0; row < 4; ++row)
      for (int column = 0; column < 4; ++column) {
        const float* from = colors + 12 * row + 3 * column;
        const float pixel[4] = {from[0], from[1], from[2], 0.0f};
        std::memcpy(out.colors[column] + 4 * row, pixel, sizeof pixel);
      }
  }
}

// Repeats the forward pass over a block's list: stores alpha (zero where it was not composited) and
// w.
XRGS_INLINE void recompute_alphas(const BatchRows& rows, const std::uint8_t* list, int count,
                                  int block, const AlphaThresholds& thresholds,
                                  const float* transmittance, AlphasAndWeights& out) {
  const Floats x = pixels_x(block), y = pixels_y(block);
  Floats running_T = load(transmittance);
  for (int at = 0; at < count; ++at) {
    const Floats alpha = alpha_at(rows[list[at]], x, y, thresholds);
    const Floats alpha_T = alpha * running_T;
    running_T = running_T - alpha_T;
    const Mask composited = thresholds.transmittance_min < running_T;
    store(out[at], select_or_zero(composited, alpha));
    store(out[at] + 16, select_or_zero(composited, alpha_T));
  }
}

// The factors of the moments: x[i] has 1, x, x^2, 0 of column i in every row; y[i] has 1, y, y^2, 0
// of row i, each in the whole of a row of its own.
struct PixelPowers {
  Floats x[4], y[4];

  explicit PixelPowers(int block) {
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

// The sum over the columns c of column c of `a` times factors[c], row by row: a product of 4x4
// matrices.
XRGS_INLINE Floats times_columns(Floats a, const Floats (&factors)[4]) {
  const Floats even = fma(broadcast_column<2>(a), factors[2], broadcast_column<0>(a) * factors[0]);
  return fma(broadcast_column<3>(a), factors[3], fma(broadcast_column<1>(a), factors[1], even));
}

// The places of a moment row that hold the sums of absolute values: its last column has no moments.
constexpr int kAbsU = 3, kAbsV = 7;

// Processes a block's list back to front and adds each Gaussian's sums over the block's pixels to
// its row of moments. Row i < 3, column j < 3 of that row, read as a 4x4 matrix, has the sum of g
// y^i x^j, and row 3 that of w v_image. With Absgrad the last column of rows 0 and 1 has those of
// |g u| and |g (chol_yy v - chol_xy u)|. `behind` is R of Eq. 17, for each pixel.
template <bool Absgrad>
XRGS_INLINE void accumulate_moments(const BatchRows& rows, const std::uint8_t* list, int count,
                                    int block, const AlphaThresholds& thresholds,
                                    const PixelGradients& v, const AlphasAndWeights& alphas,
                                    float* behind, BatchRows& moments) {
  const Floats red = load(v.red), green = load(v.green), blue = load(v.blue);
  const Floats constant = load(v.constant);
  const Floats colors[4] = {load(v.colors[0]), load(v.colors[1]), load(v.colors[2]),
                            load(v.colors[3])};
  const PixelPowers powers(block);
  const Floats x = pixels_x(block), y = pixels_y(block);  // used with Absgrad only
  Floats r = load(behind);
  for (int at = count - 1; at >= 0; --at) {
    const float* g = rows[list[at]];
    const Floats alpha = load(alphas[at]), weight = load(alphas[at] + 16);
    const Floats color_gradient =
        fma(broadcast(g[kRed]), red,
            fma(broadcast(g[kGreen]), green, fma(broadcast(g[kBlue]), blue, constant)));
    const Floats difference = color_gradient - r;
    r = fma(alpha, difference, r);
    // An alpha that is capped at alpha_max does not change with its Gaussian.
    const Floats gradient = select_or_zero(alpha < thresholds.alpha_max, weight * difference);
    const Floats by_row = times_columns(gradient, powers.x);
    float* sums = moments[list[at]];
    Floats even = fma(broadcast_row<0>(by_row), powers.y[0], load(sums));
    Floats odd = broadcast_row<1>(by_row) * powers.y[1];
    even = fma(broadcast_row<2>(by_row), powers.y[2], even);
    odd = fma(broadcast_row<3>(by_row), powers.y[3], odd);
    store(sums, add_last_row(even + odd, sum_rows(times_columns(weight, colors))));
    if constexpr (Absgrad) {
      const Floats dx = x - broadcast(g[kX]), dy = y - broadcast(g[kY]);
      const Floats u = fnma(broadcast(g[kCholXY]), dy, broadcast(g[kCholXX]) * dx);
      const Floats v_row = broadcast(g[kCholYY]) * dy;
      sums[kAbsU] += sum_lanes(abs(gradient * u));
      sums[kAbsV] +=
          sum_lanes(abs(gradient * fnma(broadcast(g[kCholXY]), u, broadcast(g[kCholYY]) * v_row)));
    }
  }
  store(behind, r);
}

// Moves the moments of a batch from the tile's centre to the Gaussians' means, and writes them to
// pair_grads.
void write_pair_grads(const BatchRows& rows, const BatchRows& moments, const TileEntry* entries,
                      int count, float* pair_grads) {
  for (int at = 0; at < count; at += 16) {
    Floats fields[16], m[16], out[16];
    for (int i = 0; i < 16; ++i) {
      fields[i] = load(rows[at + i]);
      m[i] = load(moments[at + i]);
    }
    transpose(fields);
    transpose(m);
    const Floats mean_x = fields[kX], mean_y = fields[kY];
    const Floats g = m[0], gx = m[1], gxx = m[2], gy = m[4], gxy = m[5], gyy = m[8];
    const Floats g_dx = fnma(mean_x, g, gx), g_dy = fnma(mean_y, g, gy);
    out[kGrad] = g;
    out[kGradDx] = g_dx;
    out[kGradDy] = g_dy;
    out[kGradDxDx] = fnma(mean_x, gx + g_dx, gxx);
    out[kGradDxDy] = fnma(mean_x, gy, fnma(mean_y, g_dx, gxy));
    out[kGradDyDy] = fnma(mean_y, gy + g_dy, gyy);
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

// Loads a batch and sets its moments to zero.
void load_batch(const Frame& frame, const Tile& tile, const TileEntry* entries, int count,
                BatchRows& rows, BatchRows& moments) {
  const Floats centre = centre_of(tile);
  for (int at = 0; at < count; at += 16) {
    const int lanes = count - at < 16 ? count - at : 16;
    Floats fields[16];
    load_projected(frame, entries + at, lanes, centre, fields);
    for (int i = 0; i < 16; ++i) {
      store(rows[at + i], fields[i]);
      store(moments[at + i], broadcast(0.0f));
    }
  }
}

template <bool Absgrad>
void backward_tile(const Frame& frame, int tile_index, const float* v_image, const float* v_alpha,
                   float* pair_grads) {
  const RenderConfig& config = frame.config;
  const Tile tile(frame, tile_index);
  if (tile.begin == tile.end) return;
  const AlphaThresholds thresholds(config);
  alignas(64) BatchRows rows, moments;
  alignas(64) AlphasAndWeights alphas;
  alignas(64) float behind[kBlocksPerTile][16] = {};
  PixelGradients pixel_gradients[kBlocksPerTile];
  load_pixel_gradients(tile, config, v_image, v_alpha, pixel_gradients);
  const std::uint32_t batches = (tile.end - tile.begin + kBatchSize - 1) / kBatchSize;
  const std::uint32_t composited = frame.composited_batches[tile.index];
  const TileEntry* entries = frame.entries.data() + tile.begin;
  // Batches that the forward pass never started, because every pixel was saturated, have no
  // gradient.
  for (std::uint32_t n = composited * kBatchSize; composited < batches && n < tile.end - tile.begin;
       ++n)
    stream(pair_grads + std::size_t{entries[n].pair} * kPairGradStride, broadcast(0.0f));
  for (std::uint32_t n = composited; n-- > 0;) {
    const std::uint32_t at = n * kBatchSize, remaining = tile.end - tile.begin - at;
    const int count = remaining < kBatchSize ? static_cast<int>(remaining) : kBatchSize;
    const SavedBatch& batch = frame.batches[frame.batch_offsets[tile.index] + n];
    load_batch(frame, tile, entries + at, count, rows, moments);
    // The next batch to be processed is the one in front of this, or one of the next tile.
    prefetch_batch(frame, n > 0 ? tile.begin + at - kBatchSize : tile.end);
    for (int b = 0; b < kBlocksPerTile; ++b) {
      const int listed = batch.counts[b];
      if (listed == 0) continue;
      recompute_alphas(rows, batch.lists[b], listed, b, thresholds, batch.transmittance[b], alphas);
      accumulate_moments<Absgrad>(rows, batch.lists[b], listed, b, thresholds, pixel_gradients[b],
                                  alphas, behind[b], moments);
    }
    write_pair_grads(rows, moments, entries + at, count, pair_grads);
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
