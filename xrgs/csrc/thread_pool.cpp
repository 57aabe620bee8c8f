// The pool runs one job at a time; an atomic counter distributes its tasks.
//
// A render is a dozen jobs of a fraction of a millisecond each, and waking a sleeping thread takes
// a tenth of a millisecond. So a waiting thread spins for a moment before it sleeps.
//
// The pool is never destroyed: sleeping threads end with the process. A forked child has none of
// its parent's threads, and constructs a new pool in the same memory, so that no allocation can
// fail.
#include "thread_pool.h"

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <mutex>
#include <new>
#include <system_error>
#include <thread>

#include "flush_denormals.h"

#if !defined(_WIN32)  // Windows has no fork
#include <pthread.h>
#endif

namespace xrgs {
namespace {

class ThreadPool {
 public:
  void run_job(int threads, std::int64_t count, Task task, void* context) {
    if (busy_.test_and_set(std::memory_order_acquire)) {
      for (std::int64_t i = 0; i < count; ++i) task(context, i);
      return;
    }
    start_workers(threads - 1);
    {
      std::lock_guard<std::mutex> lock(mutex_);
      task_ = task;
      context_ = context;
      count_ = count;
      next_.store(0, std::memory_order_relaxed);
      workers_to_join_ = threads - 1;
      ++generation_;
    }
    wake_.notify_all();
    run_remaining_tasks();
    {
      std::lock_guard<std::mutex> lock(mutex_);
      workers_to_join_ = 0;  // a worker that wakes now has nothing to do
    }
    spin_wait([this] { return active_workers_ == 0; });
    std::unique_lock<std::mutex> lock(mutex_);
    done_.wait(lock, [this] { return active_workers_ == 0; });
    busy_.clear(std::memory_order_release);
  }

 private:
  // Starts threads up to `count`. Only the caller that has set busy_ may call this.
  void start_workers(int count) {
    try {
      for (; started_ < count; ++started_) std::thread([this] { worker_loop(); }).detach();
    } catch (const std::system_error&) {
      // The job runs with fewer threads.
    } catch (const std::bad_alloc&) {
      // The same.
    }
  }

  // Spins until `ready`, at most about 50 us, which hardly slows down other work.
  template <class Ready>
  static void spin_wait(Ready ready) {
    const auto end = std::chrono::steady_clock::now() + std::chrono::microseconds(50);
    while (!ready() && std::chrono::steady_clock::now() < end)
      for (int i = 0; i < 16; ++i) pause();
  }

  static void pause() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    // "yield" does nothing on most processors; "isb" waits about as long as x86's "pause".
    asm volatile("isb" ::: "memory");
#endif
  }

  void run_remaining_tasks() {
    for (;;) {
      const std::int64_t index = next_.fetch_add(1, std::memory_order_relaxed);
      if (index >= count_) return;
      task_(context_, index);
    }
  }

  void worker_loop() {
    const FlushDenormals flush;  // as run_tasks for the caller
    std::uint64_t last_generation = 0;
    std::unique_lock<std::mutex> lock(mutex_);
    for (;;) {
      wake_.wait(lock, [&] { return generation_ != last_generation && workers_to_join_ > 0; });
      last_generation = generation_;
      --workers_to_join_;
      ++active_workers_;
      lock.unlock();
      run_remaining_tasks();
      lock.lock();
      if (--active_workers_ == 0) done_.notify_one();
      lock.unlock();
      spin_wait([&] { return generation_ != last_generation; });
      lock.lock();
    }
  }

  std::atomic_flag busy_ = ATOMIC_FLAG_INIT;  // set while a job runs
  std::mutex mutex_;  // guards the members below; the atomic ones may be read without it
  std::condition_variable wake_, done_;
  Task task_ = nullptr;
  void* context_ = nullptr;
  std::int64_t count_ = 0;
  std::atomic<std::int64_t> next_{0};
  std::atomic<std::uint64_t> generation_{0};  // the number of the job
  int workers_to_join_ = 0;                   // workers that may still join the job
  std::atomic<int> active_workers_{0};        // workers that have joined it and not finished
  int started_ = 0;
};

alignas(ThreadPool) unsigned char pool_memory[sizeof(ThreadPool)];

ThreadPool* new_pool() { return new (pool_memory) ThreadPool; }

#if !defined(_WIN32)
// A forked child has only one thread, so there is no race.
void replace_pool_in_child() { new_pool(); }
#endif

// This runs when the module is loaded, before a second thread could use the pool.
ThreadPool* const pool = [] {
#if !defined(_WIN32)
  pthread_atfork(nullptr, nullptr, replace_pool_in_child);
#endif
  return new_pool();
}();

}  // namespace

void run_tasks(int threads, std::int64_t count, Task task, void* context) {
  const FlushDenormals flush;
  if (threads <= 1 || count <= 1) {
    for (std::int64_t i = 0; i < count; ++i) task(context, i);
    return;
  }
  pool->run_job(threads, count, task, context);
}

}  // namespace xrgs
