// The pool: one job at a time, tasks handed out by an atomic counter.
//
// A render is a dozen jobs of a fraction of a millisecond each, and waking a sleeper takes a tenth
// of one: whoever waits looks about for a moment before it sleeps.
//
// The pool is never destroyed (threads asleep at exit are simply ended with the process), and a
// forked child, which has none of its parent's threads, starts a new one.
#include "pool.h"

#include <pthread.h>

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <mutex>
#include <system_error>
#include <thread>

namespace xrgs {
namespace {

class Pool {
 public:
  void run(int threads, std::int64_t count, Task task, void* context) {
    if (busy_.test_and_set(std::memory_order_acquire)) {
      for (std::int64_t i = 0; i < count; ++i) task(context, i);
      return;
    }
    start(threads - 1);
    {
      std::lock_guard<std::mutex> lock(mutex_);
      task_ = task;
      context_ = context;
      count_ = count;
      next_.store(0, std::memory_order_relaxed);
      seats_ = threads - 1;
      ++generation_;
    }
    wake_.notify_all();
    work();
    {
      std::lock_guard<std::mutex> lock(mutex_);
      seats_ = 0;  // whoever has not woken yet need not
    }
    look_about([this] { return working_ == 0; });
    std::unique_lock<std::mutex> lock(mutex_);
    done_.wait(lock, [this] { return working_ == 0; });
    busy_.clear(std::memory_order_release);
  }

 private:
  // Only the caller that set busy_ gets here.
  void start(int wanted) {
    try {
      for (; started_ < wanted; ++started_) std::thread([this] { loop(); }).detach();
    } catch (const std::system_error&) {
      // Fewer threads than asked for: the work gets done all the same.
    }
  }

  // Until `ready`, but no longer than some 50 us: too short to be felt by others on a busy machine.
  template <class Ready>
  static void look_about(Ready ready) {
    const auto end = std::chrono::steady_clock::now() + std::chrono::microseconds(50);
    while (!ready() && std::chrono::steady_clock::now() < end)
      for (int i = 0; i < 16; ++i) pause();
  }

  static void pause() {
#ifdef XRGS_X86
    __builtin_ia32_pause();
#endif
  }

  void work() {
    for (;;) {
      const std::int64_t index = next_.fetch_add(1, std::memory_order_relaxed);
      if (index >= count_) return;
      task_(context_, index);
    }
  }

  void loop() {
    std::uint64_t seen = 0;
    std::unique_lock<std::mutex> lock(mutex_);
    for (;;) {
      wake_.wait(lock, [&] { return generation_ != seen && seats_ > 0; });
      seen = generation_;
      --seats_;
      ++working_;
      lock.unlock();
      work();
      lock.lock();
      if (--working_ == 0) done_.notify_one();
      lock.unlock();
      look_about([&] { return generation_ != seen; });
      lock.lock();
    }
  }

  std::atomic_flag busy_ = ATOMIC_FLAG_INIT;  // set for the whole of a job
  std::mutex mutex_;                          // guards what follows, but for the atomic ones' reads
  std::condition_variable wake_, done_;
  Task task_ = nullptr;
  void* context_ = nullptr;
  std::int64_t count_ = 0;
  std::atomic<std::int64_t> next_{0};
  std::atomic<std::uint64_t> generation_{0};
  int seats_ = 0;                // workers that may still join the job
  std::atomic<int> working_{0};  // workers inside it
  int started_ = 0;
};

Pool* pool = nullptr;
std::once_flag at_fork;

// Only one thread is left in a forked child, so nothing races with this.
void forget() { pool = new Pool; }

}  // namespace

void run_tasks(int threads, std::int64_t count, Task task, void* context) {
  if (threads <= 1 || count <= 1) {
    for (std::int64_t i = 0; i < count; ++i) task(context, i);
    return;
  }
  std::call_once(at_fork, [] {
    pool = new Pool;
    pthread_atfork(nullptr, nullptr, forget);
  });
  pool->run(threads, count, task, context);
}

}  // namespace xrgs
