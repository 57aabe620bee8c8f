// A small pool of threads that sleep while there is nothing to do.
//
// Not OpenMP: a second OpenMP beside torch's own spins at its barriers, and on a machine that does
// other work too that cost 25x. Tasks are numbered; which thread runs one is left to chance, so a
// result must depend on the number alone to be the same for any count of threads.
#pragma once

#include <cstdint>

namespace xrgs {

using Task = void (*)(void* context, std::int64_t index);

// Run tasks 0..count-1 on up to `threads` threads, the caller's among them, and return when all are
// done. Tasks must not throw. A call from inside a task, or while another thread's call is running,
// runs its tasks in the caller alone. Safe in a forked child and at the interpreter's exit.
void run_tasks(int threads, std::int64_t count, Task task, void* context);

// The same with a callable: body(index).
template <class Body>
void parallel_for(int threads, std::int64_t count, Body&& body) {
  run_tasks(
      threads, count,
      [](void* context, std::int64_t index) { (*static_cast<Body*>(context))(index); }, &body);
}

}  // namespace xrgs
