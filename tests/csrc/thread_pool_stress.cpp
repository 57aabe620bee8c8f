// Runs jobs of the thread pool from several threads at once, nested in one another and in forked
// children, and counts how often each task is run. tests/csrc/thread_sanitizer.sh builds it with
// ThreadSanitizer, which ends it with an error where two threads race.
#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <numeric>
#include <thread>
#include <vector>

#include "thread_pool.h"

namespace {

using xrgs::parallel_for;

constexpr int kCallers = 4;   // threads that call the pool at once
constexpr int kRounds = 300;  // of each caller

[[noreturn]] void fail(const char* what) {
  std::fprintf(stderr, "thread_pool_stress: %s\n", what);
  std::_Exit(1);
}

// Each task writes to plain memory, which the caller reads afterwards: without an order between the
// two the sanitizer reports a race.
void run_each_task_once(int threads, std::int64_t count) {
  std::vector<int> runs(static_cast<std::size_t>(count), 0);
  parallel_for(threads, count, [&](std::int64_t i) { ++runs[static_cast<std::size_t>(i)]; });
  for (int run : runs)
    if (run != 1) fail("a task was not run exactly once");
}

// A job's memory is used by the next one at once: a worker that is late must not touch it. Some
// tasks take a while, so that workers have time to join, and the caller has to wait for them.
void reuse_memory() {
  std::vector<std::int64_t> values(16);
  for (std::int64_t job = 0; job < 20; ++job) {
    parallel_for(3, 16, [&](std::int64_t i) {
      if (i % 4 != 0) std::this_thread::sleep_for(std::chrono::microseconds(50));
      values[static_cast<std::size_t>(i)] = job + i;
    });
    if (std::accumulate(values.begin(), values.end(), std::int64_t{0}) != 16 * job + 16 * 15 / 2)
      fail("a task of another job wrote to this one's memory");
  }
}

// Each of two tasks waits for the other to begin.
void run_on_two_threads() {
  std::atomic<int> begun{0};
  parallel_for(2, 2, [&](std::int64_t) {
    ++begun;
    while (begun < 2) std::this_thread::yield();
  });
}

void run_nested() {
  std::atomic<int> sum{0};
  parallel_for(3, 5, [&](std::int64_t) { parallel_for(3, 7, [&](std::int64_t) { ++sum; }); });
  if (sum != 5 * 7) fail("a nested job was not run in full");
}

// The child's pool is new, whatever that of the parent was doing.
void run_in_child() {
  const pid_t child = fork();
  if (child < 0) fail("no child could be forked");
  if (child == 0) {
    alarm(20);  // where there is no second thread, the two tasks wait for ever
    run_on_two_threads();
    run_each_task_once(3, 100);
    std::_Exit(0);
  }
  int status = 0;
  if (waitpid(child, &status, 0) != child || status != 0) fail("a forked child failed");
}

}  // namespace

int main() {
  std::vector<std::thread> callers;
  for (int caller = 0; caller < kCallers; ++caller)
    callers.emplace_back([caller] {
      for (int round = 0; round < kRounds; ++round) {
        for (std::int64_t count : {0, 1, 2, 3, 17, 1000})
          run_each_task_once(1 + (caller + round) % 5, count);
        run_nested();
      }
    });
  for (std::thread& caller : callers) caller.join();
  for (int round = 0; round < 20; ++round) {
    run_on_two_threads();
    reuse_memory();
    run_in_child();
  }
  std::puts("thread_pool_stress: no race, and every task was run once");
}
