// xrgs._native.multiply_adds_per_second: measures the peak of the instruction set in use.
#include "bench/bind.h"

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <vector>

#include "bench/peak.h"
#include "thread_pool.h"

namespace nb = nanobind;

namespace xrgs {
namespace {

double multiply_adds_per_second(int threads) {
  constexpr std::int64_t kRounds = 100000;  // well under a millisecond
  constexpr int kTries = 50;  // the fastest counts, as other programs may use the machine too
  nb::gil_scoped_release release;
  const PeakKernels& kernels = XRGS_SELECT(peak_kernels);
  std::vector<float> results(static_cast<std::size_t>(threads));
  double best = 0;
  for (int i = 0; i < kTries; ++i) {
    const auto start = std::chrono::steady_clock::now();
    parallel_for(threads, threads, [&](std::int64_t t) {
      results[static_cast<std::size_t>(t)] = kernels.multiply_add(kRounds);
    });
    const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - start;
    best = std::max(best, 16.0 * 16.0 * kRounds * threads / seconds.count());
  }
  return best;
}

}  // namespace

void bind_bench(nb::module_& m) {
  m.def(
      "multiply_adds_per_second",
      [](int threads) {
        if (threads < 1) throw nb::value_error("threads must be at least 1");
        return multiply_adds_per_second(threads);
      },
      nb::arg("threads"),
      "Measure how many scalar float32 multiply-adds this machine can do in a second.");
}

}  // namespace xrgs
