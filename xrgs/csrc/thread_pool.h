// A small pool of threads that sleep while there is nothing to do.
//
// This is not OpenMP, because a second OpenMP runtime beside torch's own spins at its barriers,
// which was 25 times slower on a machine that does other work as well. Tasks are numbered, and any
// thread may run any of them: a result is the same for every number of threads only if a task
// depends on its number alone.
#pragma once

#include <cstdint>

namespace xrgs {

using Task = void (*)(void* context, std::int64_t index);

// Runs the tasks 0..count-1 on up to `threads` threads, one of which is the caller's, and returns
// when all are done. Tasks must not throw. A call from inside a task, and a call while that of
// another thread is running, run all of their tasks in the caller. Tasks take denormal numbers for
// zeros on every thread, whatever its state (flush_denormals.h); that of the caller is restored. It
// is safe to call this in a forked child and while the interpreter exits.
void run_tasks(int threads, std::int64_t count, Task task, void* context);

// Runs body(index) for the indices 0..count-1, as run_tasks does.
template <class Body>
void parallel_for(int threads, std::int64_t count, Body&& body) {
  run_tasks(
      threads, count,
      [](void* context, std::int64_t index) { (*static_cast<Body*>(context))(index); }, &body);
}

}  // namespace xrgs
