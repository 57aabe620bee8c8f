// A small pool of threads that sleep between jobs.
//
// OpenMP is not used: a second OpenMP runtime besides torch's spins at its barriers, which was 25
// times slower on a machine with other work. Tasks are numbered, and any thread may run any task,
// so a task may depend only on its number if the result must not depend on the number of threads.
#pragma once

#include <cstdint>

namespace xrgs {

using Task = void (*)(void* context, std::int64_t index);

// Runs the tasks 0..count-1 on up to `threads` threads, including the caller's, and returns when
// all are done. Tasks must not throw. A call from a task, or during another thread's call, runs all
// of its tasks in the calling thread. Tasks treat denormal numbers as zeros on every thread
// (flush_denormals.h); the caller's state is restored. The function may be called in a forked child
// and while the interpreter exits.
void run_tasks(int threads, std::int64_t count, Task task, void* context);

// Runs body(index) for the indices 0..count-1, as run_tasks does.
template <class Body>
void parallel_for(int threads, std::int64_t count, Body&& body) {
  run_tasks(
      threads, count,
      [](void* context, std::int64_t index) { (*static_cast<Body*>(context))(index); }, &body);
}

}  // namespace xrgs
