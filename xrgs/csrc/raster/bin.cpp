// Binning, first half: which tiles each Gaussian reaches, in depth order.
//
// Most Gaussians reach a few rows of tiles: sixteen of them go in lanes, a row of each at a time.
// One that reaches many has its rows in lanes.
#include "raster/ellipse.h"
#include "raster/stages.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

constexpr int kFewRows = 8;

// Columns begin..end of tiles in one row of tiles, for each lane.
struct Columns {
  alignas(64) std::int32_t begin[16], end[16];
};

struct Rows {
  alignas(64) std::int32_t first[16], last[16];
};

// The first and the last pixel centre of an interval, as tiles.
XRGS_INLINE Ints first_tile(Floats position) {
  return shift_right<4>(to_ints(max(ceil(position - splat(0.5f)), splat(0.0f))));
}
XRGS_INLINE Ints last_tile(Floats position, int size) {
  const Floats pixel = min(floor(position - splat(0.5f)), splat(static_cast<float>(size - 1)));
  return shift_right<4>(to_ints(max(pixel, splat(-1.0f))));
}

XRGS_INLINE void columns_of(const Ellipse& e, Floats row, const View& view, Columns& out) {
  // In a strip without end the ellipse's span is that of its box.
  const float beyond = view.skips.tiles ? 0.0f : 1e9f;
  const Floats top = fma(row, splat(static_cast<float>(kTile)), splat(0.5f - beyond));
  Floats left, right;
  const Mask reached = span(e, top, top + splat(kTile - 1.0f + 2.0f * beyond), left, right);
  // Kept within what an integer holds.
  left = min(left, splat(static_cast<float>(view.width) + kTile));
  store(out.begin, first_tile(left));
  store(out.end, last_tile(select(reached, right, splat(-1.0f)), view.width));
}

XRGS_INLINE void rows_of(const Ellipse& e, const View& view, Rows& out) {
  const Floats top = min(e.y - e.reach_y, splat(static_cast<float>(view.height) + kTile));
  store(out.first, first_tile(top));
  store(out.last, last_tile(e.y + e.reach_y, view.height));
}

struct Emitter {
  Pair* pairs;
  std::uint32_t* tile_counts;
  int columns;
  std::int64_t count = 0;

  XRGS_INLINE void row(std::uint32_t gaussian, int row, std::int32_t begin, std::int32_t end) {
    const std::uint32_t base =
        static_cast<std::uint32_t>(row) * static_cast<std::uint32_t>(columns);
    for (std::int32_t column = begin; column <= end; ++column) {
      const std::uint32_t tile = base + static_cast<std::uint32_t>(column);
      ++tile_counts[tile];
      pairs[count++] = {tile, gaussian};
    }
  }
};

// One Gaussian that reaches many rows of tiles: sixteen rows in lanes.
void emit_tall(const Record& record, std::uint32_t gaussian, int first, int last, const View& view,
               Emitter& out) {
  const Ellipse e = ellipse_of(record);
  alignas(64) float lane[16];
  for (int i = 0; i < 16; ++i) lane[i] = static_cast<float>(i);
  for (int row = first; row <= last; row += 16) {
    Columns columns;
    columns_of(e, load(lane) + splat(static_cast<float>(row)), view, columns);
    for (int i = 0; i < 16 && row + i <= last; ++i)
      out.row(gaussian, row + i, columns.begin[i], columns.end[i]);
  }
}

void emit_sixteen(Frame& frame, const std::uint64_t* order, int lanes, Emitter& out) {
  std::uint32_t gaussian[16];
  Floats fields[16];
  for (int i = 0; i < 16; ++i) {
    // Past the end: the last one again, whose pairs are not emitted.
    gaussian[i] = static_cast<std::uint32_t>(order[i < lanes ? i : lanes - 1]);
    fields[i] = load(&frame.records[gaussian[i]].x);
  }
  transpose(fields);
  const Ellipse e = ellipse_of(fields);
  Rows rows;
  rows_of(e, frame.view, rows);
  int most = 0;
  for (int i = 0; i < 16; ++i) {
    const int count = rows.last[i] - rows.first[i] + 1;
    if (count <= kFewRows && count > most) most = count;
  }
  Columns columns[kFewRows];
  alignas(64) float row[16];
  for (int i = 0; i < 16; ++i) row[i] = static_cast<float>(rows.first[i]);
  for (int k = 0; k < most; ++k)
    columns_of(e, load(row) + splat(static_cast<float>(k)), frame.view, columns[k]);
  for (int i = 0; i < lanes; ++i) {
    const int count = rows.last[i] - rows.first[i] + 1;
    const std::int64_t before = out.count;
    if (count > kFewRows)
      emit_tall(frame.records[gaussian[i]], gaussian[i], rows.first[i], rows.last[i], frame.view,
                out);
    else
      for (int k = 0; k < count; ++k)
        out.row(gaussian[i], rows.first[i] + k, columns[k].begin[i], columns[k].end[i]);
    frame.slots[gaussian[i]].count = static_cast<std::uint32_t>(out.count - before);
  }
}

}  // namespace

std::int64_t emit(Frame& frame, std::int64_t* next, std::int64_t last, Pair* pairs,
                  std::int64_t room, std::uint32_t* tile_counts) {
  const int columns = frame.view.columns();
  const std::int64_t group_room = std::int64_t{16} * columns * frame.view.rows();
  const std::uint64_t* order = frame.order.data();
  Emitter out{pairs, tile_counts, columns};
  std::int64_t at = *next;
  for (; at < last && out.count + group_room <= room; at += 16) {
    for (std::int64_t i = at + 16; i < at + 32 && i < last; ++i)
      prefetch(&frame.records[static_cast<std::uint32_t>(order[i])]);
    const int lanes = last - at < 16 ? static_cast<int>(last - at) : 16;
    emit_sixteen(frame, order + at, lanes, out);
  }
  *next = at < last ? at : last;
  return out.count;
}

}  // namespace XRGS_NS
}  // namespace xrgs
