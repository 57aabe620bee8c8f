// The expected values come from scalar C++ and the compiler's builtins, one lane at a time.
#include <cstdint>
#include <cstdio>
#include <cstring>

#include "simd/simd.h"
#include "simd_checks.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

const float kValues[] = {0.0f,
                         -0.0f,
                         1.0f,
                         -1.0f,
                         0.5f,
                         -0.5f,
                         1.5f,
                         -1.5f,
                         0.3f,
                         -0.3f,
                         0.99999994f,
                         -0.99999994f,
                         7.25f,
                         -1234.5f,
                         8388607.5f,
                         -8388607.5f,
                         8388609.0f,
                         -8388609.0f,
                         2147483520.0f,
                         -2147483648.0f,
                         1e-30f,
                         -1e-30f,
                         3.0e38f,
                         -3.0e38f,
                         1e30f,
                         1.17549435e-38f,
                         1e-40f,
                         -1e-40f,
                         __builtin_inff(),
                         -__builtin_inff(),
                         __builtin_nanf(""),
                         123.456f};
constexpr int kCount = sizeof kValues / sizeof kValues[0];
static_assert(kCount % kLanes == 0);

int failures = 0;

void expect(bool holds, const char* operation, int lane) {
  if (holds) return;
  ++failures;
  std::printf("%s differs in lane %d\n", operation, lane);
}

std::uint32_t bits_of(float a) {
  std::uint32_t bits;
  std::memcpy(&bits, &a, sizeof bits);
  return bits;
}

// Equal bits, or both NaN: which NaN an operation returns is not specified.
bool same(float a, float b) { return bits_of(a) == bits_of(b) || (a != a && b != b); }

bool fits_int(float a) { return a >= -2147483648.0f && a < 2147483648.0f; }

// Sixteen of the values, from `first` on and around the end.
Floats values(int first) {
  float lanes[kLanes];
  for (int i = 0; i < kLanes; ++i) lanes[i] = kValues[(first + i) % kCount];
  return load(lanes);
}

float lane_of(Floats a, int lane) {
  float lanes[kLanes];
  store(lanes, a);
  return lanes[lane];
}

template <class Expected>
void expect_floats(const char* operation, Floats actual, Expected&& expected) {
  for (int i = 0; i < kLanes; ++i) expect(same(lane_of(actual, i), expected(i)), operation, i);
}

template <class Expected>
void expect_ints(const char* operation, Ints actual, Expected&& expected) {
  std::int32_t lanes[kLanes];
  store(lanes, actual);
  for (int i = 0; i < kLanes; ++i) expect(lanes[i] == expected(i), operation, i);
}

template <class Expected>
void expect_mask(const char* operation, Mask actual, Expected&& expected) {
  for (int i = 0; i < kLanes; ++i)
    expect((to_bits(actual) >> i & 1u) == (expected(i) ? 1u : 0u), operation, i);
  expect(to_bits(actual) >> kLanes == 0, operation, kLanes);
}

void check_one_argument(int first) {
  const Floats a = values(first);
  const auto at = [first](int i) { return kValues[(first + i) % kCount]; };
  expect_floats("load", a, at);
  expect_floats("abs", abs(a), [&](int i) { return __builtin_fabsf(at(i)); });
  expect_floats("sqrt", sqrt(a), [&](int i) { return __builtin_sqrtf(at(i)); });
  expect_floats("floor", floor(a), [&](int i) { return __builtin_floorf(at(i)); });
  expect_floats("ceil", ceil(a), [&](int i) { return __builtin_ceilf(at(i)); });
  expect_floats("as_floats", as_floats(as_ints(a)), at);
  const Mask fits = (broadcast(-2147483648.0f) <= a) & (a < broadcast(2147483648.0f));
  const Floats bounded = select_or_zero(fits, a);
  expect_floats("select_or_zero", bounded, [&](int i) { return fits_int(at(i)) ? at(i) : 0.0f; });
  const Floats third = broadcast(0.3f);
  expect_floats("multiply_where", multiply_where(fits, a, third),
                [&](int i) { return fits_int(at(i)) ? at(i) * 0.3f : 0.0f; });
  expect_floats("min_positive_where", min_positive_where(fits, abs(a), third), [&](int i) {
    return fits_int(at(i)) ? lane_of(min_positive(abs(a), third), i) : 0.0f;
  });
  expect_ints("to_ints", to_ints(bounded),
              [&](int i) { return fits_int(at(i)) ? static_cast<std::int32_t>(at(i)) : 0; });
}

void check_two_arguments(int first, int second) {
  const Floats a = values(first), b = values(second);
  const auto x = [first](int i) { return kValues[(first + i) % kCount]; };
  const auto y = [second](int i) { return kValues[(second + i) % kCount]; };
  expect_floats("+", a + b, [&](int i) { return x(i) + y(i); });
  expect_floats("-", a - b, [&](int i) { return x(i) - y(i); });
  expect_floats("*", a * b, [&](int i) { return x(i) * y(i); });
  expect_floats("/", a / b, [&](int i) { return x(i) / y(i); });
  expect_floats("min", min(a, b), [&](int i) { return x(i) < y(i) ? x(i) : y(i); });
  expect_floats("max", max(a, b), [&](int i) { return x(i) > y(i) ? x(i) : y(i); });
  expect_floats("min_positive", min_positive(abs(a), broadcast(0.99f)), [&](int i) {
    const float positive = __builtin_fabsf(x(i));
    // What the minimum of NaN is, is not specified.
    return x(i) != x(i) ? lane_of(min_positive(abs(a), broadcast(0.99f)), i)
                        : (positive < 0.99f ? positive : 0.99f);
  });
  expect_mask("<", a < b, [&](int i) { return x(i) < y(i); });
  expect_mask("<=", a <= b, [&](int i) { return x(i) <= y(i); });
  expect_mask("==", a == b, [&](int i) { return x(i) == y(i); });
  expect_mask("&", (a < b) & (broadcast(0.0f) < a),
              [&](int i) { return x(i) < y(i) && 0.0f < x(i); });
  expect_floats("select", select(a < b, a, b), [&](int i) { return x(i) < y(i) ? x(i) : y(i); });
  const Floats c = broadcast(0.1f);
  expect_floats("fma", fma(a, b, c), [&](int i) {
    return kFusedMultiplyAdd ? __builtin_fmaf(x(i), y(i), 0.1f) : x(i) * y(i) + 0.1f;
  });
  expect_floats("fnma", fnma(a, b, c), [&](int i) {
    return kFusedMultiplyAdd ? __builtin_fmaf(-x(i), y(i), 0.1f) : 0.1f - x(i) * y(i);
  });
}

void check_integers() {
  const std::int32_t lanes[kLanes] = {0,        1,         -1,         2147483647, -2147483647 - 1,
                                      16777217, -16777219, 2147483583, 123456789,  -987654321,
                                      8388608,  1 << 30,   255,        -256,       33554435,
                                      7};
  float as_bits[kLanes];
  std::memcpy(as_bits, lanes, sizeof lanes);
  const Ints a = as_ints(load(as_bits)), b = broadcast_int(1234567890);
  const auto wrapped = [](std::int64_t value) {
    return static_cast<std::int32_t>(static_cast<std::uint32_t>(value));
  };
  expect_ints("Ints +", a + b, [&](int i) { return wrapped(std::int64_t{lanes[i]} + 1234567890); });
  expect_ints("Ints -", a - b, [&](int i) { return wrapped(std::int64_t{lanes[i]} - 1234567890); });
  expect_ints("shift_left", shift_left<23>(a),
              [&](int i) { return wrapped(std::int64_t{lanes[i]} * (1 << 23)); });
  expect_ints("shift_right", shift_right<4>(a), [&](int i) { return lanes[i] >> 4; });
  expect_floats("to_floats", to_floats(a), [&](int i) { return static_cast<float>(lanes[i]); });
}

void check_masks() {
  for (std::uint32_t bits : {0u, 1u, 0x8000u, 0xffffu, 0x1234u, 0xedcbu}) {
    expect_mask("mask_from_bits", mask_from_bits(bits),
                [bits](int i) { return (bits >> i & 1u) != 0; });
    expect(any(mask_from_bits(bits)) == (bits != 0), "any", 0);
  }
}

void check_partial_memory() {
  const Floats a = values(5);
  for (int count = 0; count <= kLanes; ++count) {
    float memory[kLanes];
    for (float& value : memory) value = 42.0f;
    store_first(memory, a, count);
    for (int i = 0; i < kLanes; ++i)
      expect(same(memory[i], i < count ? kValues[5 + i] : 42.0f), "store_first", i);
    expect_floats("load_first", load_first(memory, count),
                  [&](int i) { return i < count ? memory[i] : 0.0f; });
  }
  alignas(64) float streamed[kLanes];
  stream(streamed, a);
  stream_fence();
  expect_floats("stream", load(streamed), [](int i) { return kValues[5 + i]; });
}

// Checks the operations that move or add lanes. The values are such that the order of a sum shows.
void check_lanes() {
  float a[kLanes], b[kLanes];
  for (int i = 0; i < kLanes; ++i) {
    a[i] = 1.0f / static_cast<float>(i + 1);
    b[i] = 1000.0f / static_cast<float>(2 * i + 3);
  }
  const Floats x = load(a), y = load(b);
  Floats low, high, even, odd;
  interleave(x, y, low, high);
  expect_floats("interleave", low, [&](int i) { return i % 2 == 0 ? a[i / 2] : b[i / 2]; });
  expect_floats("interleave", high,
                [&](int i) { return i % 2 == 0 ? a[8 + i / 2] : b[8 + i / 2]; });
  deinterleave(low, high, even, odd);
  expect_floats("deinterleave", even, [&](int i) { return a[i]; });
  expect_floats("deinterleave", odd, [&](int i) { return b[i]; });
  expect_floats("broadcast_column<0>", broadcast_column<0>(x), [&](int i) { return a[i / 4 * 4]; });
  expect_floats("broadcast_column<3>", broadcast_column<3>(x),
                [&](int i) { return a[i / 4 * 4 + 3]; });
  expect_floats("broadcast_row<1>", broadcast_row<1>(x), [&](int i) { return a[4 + i % 4]; });
  expect_floats("broadcast_row<2>", broadcast_row<2>(x), [&](int i) { return a[8 + i % 4]; });
  expect_floats("sum_rows", sum_rows(x), [&](int i) {
    const float* column = a + i % 4;
    return (column[0] + column[8]) + (column[4] + column[12]);
  });
  float sums[kLanes];
  std::memcpy(sums, a, sizeof sums);
  for (int width = kLanes / 2; width > 0; width /= 2)
    for (int i = 0; i < width; ++i) sums[i] += sums[i + width];
  expect(same(sum_lanes(x), sums[0]), "sum_lanes", 0);
}

void check_transposes() {
  Floats rows[kLanes];
  float numbers[4 * kLanes * kLanes], written[4 * kLanes];
  for (int i = 0; i < 4 * kLanes * kLanes; ++i) numbers[i] = static_cast<float>(i);
  for (int row = 0; row < kLanes; ++row) rows[row] = load(numbers + kLanes * row);
  transpose(rows);
  for (int row = 0; row < kLanes; ++row)
    expect_floats("transpose", rows[row], [&](int i) { return numbers[kLanes * i + row]; });
  Floats parts[4];
  load_triples(numbers, parts[0], parts[1], parts[2]);
  for (int k = 0; k < 3; ++k)
    expect_floats("load_triples", parts[k], [&](int i) { return numbers[3 * i + k]; });
  store_triples(written, parts[0], parts[1], parts[2]);
  for (int i = 0; i < 3 * kLanes; ++i) expect(written[i] == numbers[i], "store_triples", i);
  load_quadruples(numbers, parts[0], parts[1], parts[2], parts[3]);
  for (int k = 0; k < 4; ++k)
    expect_floats("load_quadruples", parts[k], [&](int i) { return numbers[4 * i + k]; });
  store_quadruples(written, parts[0], parts[1], parts[2], parts[3]);
  for (int i = 0; i < 4 * kLanes; ++i) expect(written[i] == numbers[i], "store_quadruples", i);
  parts[0] = repeat_thrice<0>(numbers), parts[1] = repeat_thrice<1>(numbers);
  parts[2] = repeat_thrice<2>(numbers);
  for (int k = 0; k < 3; ++k)
    expect_floats("repeat_thrice", parts[k], [&](int i) { return numbers[(kLanes * k + i) / 3]; });
  parts[0] = repeat_triple<0>(numbers), parts[1] = repeat_triple<1>(numbers);
  parts[2] = repeat_triple<2>(numbers);
  for (int k = 0; k < 3; ++k)
    expect_floats("repeat_triple", parts[k], [&](int i) { return numbers[(kLanes * k + i) % 3]; });
}

int run() {
  failures = 0;
  for (int first = 0; first < kCount; ++first) {
    check_one_argument(first);
    for (int second = 0; second < kCount; ++second) check_two_arguments(first, second);
  }
  check_integers();
  check_masks();
  check_partial_memory();
  check_lanes();
  check_transposes();
  return failures;
}

}  // namespace

extern const SimdChecks simd_checks{run};

}  // namespace XRGS_NS
}  // namespace xrgs
