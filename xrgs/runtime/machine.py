"""Cores, threads and memory that this process uses, and the processes of this machine."""

from __future__ import annotations

import atexit
import gc
import math
import os
import resource
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path, PurePosixPath
from typing import TypeVar

import psutil

_In = TypeVar("_In")
_Out = TypeVar("_Out")


def usable_cores() -> int:
    """Count the cores that this process may use, at least one.

    It is the least of the CPU affinity, the CPU quota of the container, rounded up, and the number
    that PYTHON_CPU_COUNT gives.
    """
    counts: list[float] = [os.cpu_count() or 1, cpu_quota()]
    if hasattr(os, "sched_getaffinity"):
        counts.append(len(os.sched_getaffinity(0)))
    if (count := os.environ.get("PYTHON_CPU_COUNT", "")).isdecimal():
        counts.append(int(count))
    return max(1, math.ceil(min(counts)))


def cpu_quota(root: Path = Path("/")) -> float:
    """Return the CPU quota of this process's control groups, in cores; infinite without one."""
    quotas = [math.inf]
    for folder in _control_groups(root, "cpu"):
        # Version 2 writes `max` for no quota, version 1 writes -1.
        both = _words(folder / "cpu.max") or (
            _words(folder / "cpu.cfs_quota_us") + _words(folder / "cpu.cfs_period_us")
        )
        if len(both) == 2 and all(word.isdecimal() for word in both):
            quotas.append(int(both[0]) / int(both[1]))
    return min(quotas)


def usable_memory(root: Path = Path("/")) -> int:
    """Return the memory that this process may use at most, in bytes.

    It is the least of the machine's memory and the memory limits of the process's control groups.
    """
    limits = [int(psutil.virtual_memory().total)]
    for folder in _control_groups(root, "memory"):
        # Version 2 writes `max` for no limit, version 1 a number beyond any memory.
        for name in ("memory.max", "memory.limit_in_bytes"):
            limits += [int(word) for word in _words(folder / name) if word.isdecimal()]
    return min(limits)


def _control_groups(root: Path, controller: str) -> Iterator[Path]:
    """Yield the folders of the control groups of this process, each group before the one above it.

    A limit of a group holds for all groups below it. Version 2 has one tree of groups, and version
    1 has one for each controller; a machine can have both.
    """
    try:
        lines = (root / "proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if not controllers:
            mounts = ("", "unified")
        elif controller in controllers.split(","):
            mounts = (controllers, controller)
        else:
            continue
        # In a container the path may be that of outside. Then only the mount itself is there: it is
        # the container's group.
        for group in (PurePosixPath(path), *PurePosixPath(path).parents):
            for mount in mounts:
                yield root / "sys/fs/cgroup" / mount / group.relative_to("/")


def _words(file: Path) -> list[str]:
    try:
        return file.read_text(encoding="ascii").split()
    except OSError:
        return []


def peak_rss() -> int:
    """Return the largest resident memory of this process so far, in bytes."""
    unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def set_portable_blas(cpuinfo: Path = Path("/proc/cpuinfo")) -> None:
    """Make OpenBLAS in child processes (numpy's, pycolmap's) use AVX2 where the processor has it.

    OpenBLAS has other kernels for processors with AVX-512, whose last digits differ. A value of
    OPENBLAS_CORETYPE that is already in the environment is kept. On systems other than Linux
    nothing is set.
    """
    if {"avx2", "fma"} <= set(_words(cpuinfo)):
        os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")


def set_portable_mkl() -> None:
    """Make MKL, torch's BLAS, compute with the same instructions on every x86-64 processor.

    By default it has other kernels for AVX2, for AVX-512 and for AMD, whose last digits differ.
    They turned single pixels of the embedded scene, and so its cameras. MKL reads MKL_CBWR at its
    first call. A value that is already in the environment is kept.
    """
    os.environ.setdefault("MKL_CBWR", "COMPATIBLE")


def set_huge_pages() -> None:
    """Make glibc of child processes take memory in huge pages, and keep some that is freed.

    Torch allocates each gradient and each copy of the Gaussians anew. With pages of 4 KB, page
    faults took a quarter to a third of a short run (fern, 200 steps, 150,000 Gaussians). A value of
    GLIBC_TUNABLES that is already in the environment is kept. Other C libraries don't read it.
    """
    sizes = {"mmap_threshold": 2**25, "trim_threshold": 2**28}  # bytes
    tunables = ("hugetlb=1", *(f"{name}={size}" for name, size in sizes.items()))
    os.environ.setdefault("GLIBC_TUNABLES", ":".join(f"glibc.malloc.{each}" for each in tunables))


@contextmanager
def without_collections() -> Iterator[None]:
    """Stop Python's garbage collection during a block that imports large modules.

    The import of torch makes hundreds of thousands of objects, of which none is garbage. Otherwise
    they are searched for garbage again and again, which takes a tenth of the import's time.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def end_quickly() -> None:
    """Let Python search nothing for garbage when this process ends.

    Otherwise it searches all objects several times, which takes a fifth of a second or more where
    torch or pandas is imported. All the memory goes back to the system anyway.
    """
    atexit.register(gc.freeze)


def set_torch_threads(threads: int) -> int:
    """Set the number of torch's threads, 0 for every usable core; return the number."""
    import torch

    torch.set_num_threads(threads or usable_cores())
    return torch.get_num_threads()


def wait_for_gpu() -> None:
    """Wait until the GPU, where one is used, has finished this process's work: for timing."""
    import torch

    if torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
        torch.cuda.synchronize()


def gpus() -> list[str]:
    """Return the NVIDIA GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        names = [name.strip() for name in visible.split(",")]
        return [name for name in names if name not in {"", "-1", "NoDevFiles"}]
    import torch

    return [str(number) for number in range(torch.cuda.device_count())]


@contextmanager
def torch_threads(count: int) -> Iterator[int]:
    """Set the threads of torch and the kernels in a block; yield the number before and after it."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(count)  # the kernels read torch's number
    try:
        yield threads
    finally:
        torch.set_num_threads(threads)


def on_threads(function: Callable[[_In], _Out], items: Iterable[_In]) -> Iterator[_Out]:
    """Yield `function(item)` of each item, in order. Several items are in work, one per thread.

    There are as many threads as torch has, and torch has one within each. So no bit depends on the
    number of threads, and on a busy machine torch's threads do not wait for each other.
    """
    with torch_threads(1) as threads, ThreadPoolExecutor(threads) as pool:
        yield from pool.map(function, items)


#: Two readings of a process's start may differ by less than this many seconds: boot times are
#: rounded, and move with the clock. No later process has the same id so soon.
_START_S = 2.0


@cache
def boot() -> str:
    """Return an id of this boot and this process namespace; empty where the system has none."""
    try:
        boot_id = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot_id} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return ""


def started(pid: int) -> float:
    """Return when a process started, in seconds after the boot."""
    # Not in seconds since the epoch: these change for a running process when the clock is set.
    return round(float(psutil.Process(pid).create_time() - psutil.boot_time()), 2)


def lives(pid: int, start: float) -> bool:
    """Return whether the process with this id and start exists, suspended or not.

    A zombie, which has ended and whose parent has not waited for it, does not live.
    """
    try:
        ended = psutil.Process(pid).status() in {psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD}
        return not ended and abs(started(pid) - start) < _START_S
    except psutil.NoSuchProcess:
        return False


def resident_bytes(session: int) -> int:
    """Return the resident bytes of all processes of a session, by the id of its first process.

    Shared pages count for each.
    """
    total: int = 0
    for pid in psutil.pids():
        with suppress(ProcessLookupError, psutil.NoSuchProcess):  # it may end while it is read
            if os.getsid(pid) == session:
                total += psutil.Process(pid).memory_info().rss
    return total


def offer_to_oom_killer() -> None:
    """Let the kernel kill this process before others when the machine runs out of memory."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")
