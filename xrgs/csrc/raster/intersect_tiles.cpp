// Finds the tiles that each Gaussian's cutoff ellipse overlaps, in depth order.
//
// Most ellipses overlap few rows of tiles: sixteen Gaussians are processed together, each with one
// row of tiles at a time. For a Gaussian that overlaps many rows, sixteen of its rows are processed
// together.
#include "raster/cutoff_ellipse.h"
#include "raster/stages.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

constexpr int kFewRows = 8;

// The columns of tiles first..last that an ellipse overlaps in one row of tiles, for each lane.
struct TileColumns {
  alignas(64) std::int32_t first[16], last[16];
};

// The rows of tiles first..last that an ellipse overlaps, for each lane.
struct TileRows {
  alignas(64) std::int32_t first[16], last[16];
};

// The tile of the first pixel centre at or after `position`.
XRGS_INLINE Ints first_tile(Floats position) {
  return shift_right<4>(to_ints(max(ceil(position - broadcast(0.5f)), broadcast(0.0f))));
}

// The tile of the last pixel centre at or before `position`, within an image of `size` pixels.
XRGS_INLINE Ints last_tile(Floats position, int size) {
  const Floats pixel =
      min(floor(position - broadcast(0.5f)), broadcast(static_cast<float>(size - 1)));
  return shift_right<4>(to_ints(max(pixel, broadcast(-1.0f))));
}

XRGS_INLINE void find_columns(const CutoffEllipse& e, Floats tile_row, const RenderConfig& config,
                              TileColumns& out) {
  // In a sufficiently high strip, the extent is that of the bounding box.
  const float beyond = config.culling.tiles ? 0.0f : 1e9f;
  const Floats top =
      fma(tile_row, broadcast(static_cast<float>(kTileSize)), broadcast(0.5f - beyond));
  Floats left, right;
  const Mask overlaps =
      strip_extent(e, top, top + broadcast(kTileSize - 1.0f + 2.0f * beyond), left, right);
  // Bounded to the range of integers.
  left = min(left, broadcast(static_cast<float>(config.width) + kTileSize));
  store(out.first, first_tile(left));
  store(out.last, last_tile(select(overlaps, right, broadcast(-1.0f)), config.width));
}

XRGS_INLINE void find_rows(const CutoffEllipse& e, const RenderConfig& config, TileRows& out) {
  const Floats top =
      min(e.y - e.radius_y, broadcast(static_cast<float>(config.height) + kTileSize));
  store(out.first, first_tile(top));
  store(out.last, last_tile(e.y + e.radius_y, config.height));
}

struct IntersectionWriter {
  TileIntersection* intersections;
  std::uint32_t* tile_counts;
  int tile_columns;
  std::int64_t count = 0;

  // Writes the tiles first..last of one row of tiles.
  XRGS_INLINE void write_row(std::uint32_t gaussian, int tile_row, std::int32_t first,
                             std::int32_t last) {
    const std::uint32_t base =
        static_cast<std::uint32_t>(tile_row) * static_cast<std::uint32_t>(tile_columns);
    for (std::int32_t column = first; column <= last; ++column) {
      const std::uint32_t tile = base + static_cast<std::uint32_t>(column);
      ++tile_counts[tile];
      intersections[count++] = {tile, gaussian};
    }
  }
};

// Intersects one Gaussian with the rows of tiles first..last, sixteen rows at a time.
void intersect_tall(const ProjectedGaussian& g, std::uint32_t gaussian, int first, int last,
                    const RenderConfig& config, IntersectionWriter& out) {
  const CutoffEllipse e = cutoff_ellipse(g);
  alignas(64) float lane[16];
  for (int i = 0; i < 16; ++i) lane[i] = static_cast<float>(i);
  for (int row = first; row <= last; row += 16) {
    TileColumns columns;
    find_columns(e, load(lane) + broadcast(static_cast<float>(row)), config, columns);
    for (int i = 0; i < 16 && row + i <= last; ++i)
      out.write_row(gaussian, row + i, columns.first[i], columns.last[i]);
  }
}

// Intersects the first `lanes` Gaussians of `order`, at most sixteen.
void intersect_group(Frame& frame, const std::uint64_t* order, int lanes, IntersectionWriter& out) {
  std::uint32_t gaussian[16];
  Floats fields[16];
  for (int i = 0; i < 16; ++i) {
    // Lanes past the end are copies of the last Gaussian; their pairs are not written.
    gaussian[i] = static_cast<std::uint32_t>(order[i < lanes ? i : lanes - 1]);
    fields[i] = load(&frame.projected[gaussian[i]].mean2d_x);
  }
  transpose(fields);
  const CutoffEllipse e = cutoff_ellipse(fields);
  TileRows rows;
  find_rows(e, frame.config, rows);
  int most_rows = 0;
  for (int i = 0; i < 16; ++i) {
    const int count = rows.last[i] - rows.first[i] + 1;
    if (count <= kFewRows && count > most_rows) most_rows = count;
  }
  TileColumns columns[kFewRows];
  alignas(64) float first_row[16];
  for (int i = 0; i < 16; ++i) first_row[i] = static_cast<float>(rows.first[i]);
  for (int k = 0; k < most_rows; ++k)
    find_columns(e, load(first_row) + broadcast(static_cast<float>(k)), frame.config, columns[k]);
  for (int i = 0; i < lanes; ++i) {
    const int count = rows.last[i] - rows.first[i] + 1;
    const std::int64_t count_before = out.count;
    if (count > kFewRows)
      intersect_tall(frame.projected[gaussian[i]], gaussian[i], rows.first[i], rows.last[i],
                     frame.config, out);
    else
      for (int k = 0; k < count; ++k)
        out.write_row(gaussian[i], rows.first[i] + k, columns[k].first[i], columns[k].last[i]);
    frame.pair_ranges[gaussian[i]].count = static_cast<std::uint32_t>(out.count - count_before);
  }
}

}  // namespace

std::int64_t intersect_tiles(Frame& frame, std::int64_t* next, std::int64_t last,
                             TileIntersection* intersections, std::int64_t capacity,
                             std::uint32_t* tile_counts) {
  const int tile_columns = frame.config.tile_columns();
  const std::int64_t most_per_group = std::int64_t{16} * tile_columns * frame.config.tile_rows();
  const std::uint64_t* order = frame.order.data();
  IntersectionWriter out{intersections, tile_counts, tile_columns};
  std::int64_t at = *next;
  for (; at < last && out.count + most_per_group <= capacity; at += 16) {
    for (std::int64_t i = at + 16; i < at + 32 && i < last; ++i)
      prefetch(&frame.projected[static_cast<std::uint32_t>(order[i])]);
    const int lanes = last - at < 16 ? static_cast<int>(last - at) : 16;
    intersect_group(frame, order + at, lanes, out);
  }
  *next = at < last ? at : last;
  return out.count;
}

}  // namespace XRGS_NS
}  // namespace xrgs
