"""Cores, memory, torch's threads, and OpenMP's wait policy."""

from __future__ import annotations

import gc
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
import torch

from tests.runtime.programs import run_python
from xrgs.runtime import machine
from xrgs.runtime.machine import (
    gpus,
    set_portable_blas,
    set_portable_mkl,
    torch_threads,
    usable_cores,
    without_collections,
)


@pytest.mark.parametrize(("given", "cores"), [("1", 1), ("0", 1), ("default", None)])
def test_the_cores_are_at_most_those_that_python_is_told(
    monkeypatch: pytest.MonkeyPatch, given: str, cores: int | None
) -> None:
    monkeypatch.delenv("PYTHON_CPU_COUNT", raising=False)
    before = usable_cores()
    monkeypatch.setenv("PYTHON_CPU_COUNT", given)
    assert usable_cores() == (cores or before)


def test_the_cores_are_at_most_the_quota_rounded_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYTHON_CPU_COUNT", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(64), raising=False)
    for quota, cores in ((math.inf, 64), (2.5, 3), (2.0, 2), (0.1, 1), (100.0, 64)):
        monkeypatch.setattr(machine, "cpu_quota", lambda quota=quota: quota)
        assert usable_cores() == cores


#: What control groups say, by version and place: the file `/proc/self/cgroup`, the other files
#: below `/sys/fs/cgroup`, and the quota.
GROUPS = {
    "a container of version 2": ("0::/", {"cpu.max": "150000 100000"}, 1.5),
    "no quota": ("0::/", {"cpu.max": "max 100000"}, math.inf),
    "the least of several": (
        "0::/user/job",
        {"user/cpu.max": "400000 100000", "user/job/cpu.max": "50000 100000"},
        0.5,
    ),
    "a container of version 1": (
        "4:cpu,cpuacct:/docker/abc\n2:memory:/docker/abc",
        {"cpu,cpuacct/cpu.cfs_quota_us": "300000", "cpu,cpuacct/cpu.cfs_period_us": "100000"},
        3.0,
    ),
    "version 1 without a quota": (
        "1:cpu:/",
        {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"},
        math.inf,
    ),
    "a group outside of the container": ("0::/../other", {"cpu.max": "100000 100000"}, 1.0),
    "not Linux": (None, {}, math.inf),
}


def write_groups(root: Path, own: str | None, groups: dict[str, str]) -> None:
    files = {f"sys/fs/cgroup/{name}": text for name, text in groups.items()}
    if own is not None:
        files["proc/self/cgroup"] = own
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(f"{text}\n")


@pytest.mark.parametrize("case", GROUPS)
def test_the_quota_is_the_least_of_the_control_groups(tmp_path: Path, case: str) -> None:
    own, files, quota = GROUPS[case]
    write_groups(tmp_path, own, files)
    assert machine.cpu_quota(tmp_path) == quota


@pytest.mark.parametrize(
    ("own", "files", "limit"),
    [
        ("0::/a/b", {"a/b/memory.max": "max", "a/memory.max": "1000000"}, 1_000_000),
        ("3:memory:/docker/x", {"memory/memory.limit_in_bytes": "2000000"}, 2_000_000),
        ("3:memory:/", {"memory/memory.limit_in_bytes": "9223372036854771712"}, None),
    ],
)
def test_the_memory_is_the_least_of_the_machine_and_its_control_groups(
    tmp_path: Path, own: str, files: dict[str, str], limit: int | None
) -> None:
    write_groups(tmp_path, own, files)
    assert machine.usable_memory(tmp_path) == (limit or psutil.virtual_memory().total)


def test_a_block_has_one_thread_and_the_others_return_at_its_end() -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        with torch_threads(1) as threads:
            assert (threads, torch.get_num_threads()) == (3, 1)
        assert torch.get_num_threads() == 3
        with pytest.raises(ZeroDivisionError), torch_threads(1):
            _ = 1 / 0
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_openblas_has_the_kernels_of_avx2_wherever_there_is_avx2(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("OPENBLAS_CORETYPE", raising=False)
    cpuinfo = tmp_path / "cpuinfo"
    set_portable_blas(cpuinfo)  # not Linux
    cpuinfo.write_text("flags : fpu sse2 avx")
    set_portable_blas(cpuinfo)
    assert "OPENBLAS_CORETYPE" not in os.environ
    cpuinfo.write_text("flags : fpu sse2 avx fma avx2 avx512f")
    set_portable_blas(cpuinfo)
    assert os.environ["OPENBLAS_CORETYPE"] == "Haswell"
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Zen")
    set_portable_blas(cpuinfo)
    assert os.environ["OPENBLAS_CORETYPE"] == "Zen"


def test_mkl_computes_alike_on_every_processor_unless_the_user_says_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("MKL_CBWR", raising=False)
    set_portable_mkl()
    assert os.environ["MKL_CBWR"] == "COMPATIBLE"
    monkeypatch.setenv("MKL_CBWR", "AVX2")
    set_portable_mkl()
    assert os.environ["MKL_CBWR"] == "AVX2"


@pytest.mark.parametrize(
    ("visible", "names"),
    [
        ("2, 0", ["2", "0"]),
        ("-1", []),
        ("NoDevFiles", []),  # as SLURM has it for a job that asked for none
    ],
)
def test_the_gpus_are_those_that_are_visible(
    monkeypatch: pytest.MonkeyPatch, visible: str, names: list[str]
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert gpus() == names
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert gpus() == ["0", "1"]


def test_a_process_is_told_from_others_by_its_start_until_it_is_dead() -> None:
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]) as child:
        began = machine.started(child.pid)
        assert began >= machine.started(os.getpid())
        assert machine.started(child.pid) == began
        assert not machine.lives(child.pid, began - 10)
        os.kill(child.pid, signal.SIGSTOP)
        assert machine.lives(child.pid, began)
        child.kill()
        end = time.monotonic() + 10
        while machine.lives(child.pid, began):  # nobody has waited for it
            assert time.monotonic() < end
            time.sleep(0.01)
    assert not machine.lives(child.pid, began)
    with pytest.raises(psutil.NoSuchProcess):
        machine.started(child.pid)


def test_a_clock_that_is_set_changes_no_start(monkeypatch: pytest.MonkeyPatch) -> None:
    began, booted = machine.started(os.getpid()), psutil.boot_time()
    monkeypatch.setattr(psutil, "boot_time", lambda: booted + 3600)
    monkeypatch.setattr(psutil._psplatform, "boot_time", lambda: booted + 3600)
    assert machine.started(os.getpid()) == pytest.approx(began, abs=0.02)


def test_memory_is_that_of_all_processes_of_a_session() -> None:
    text = "x = b'x' * 50_000_000; print(flush=True); import time; time.sleep(600)"
    command = [sys.executable, "-c", text]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as child:
        assert child.stdout is not None
        child.stdout.readline()
        assert 50e6 < machine.resident_bytes(child.pid) < 500e6
        child.kill()
    assert machine.resident_bytes(child.pid) == 0


def test_nothing_is_looked_through_at_the_end_of_a_quick_process() -> None:
    last = "import atexit, gc; atexit.register(lambda: print(gc.get_freeze_count() > 0))"
    quick = "from xrgs.runtime.machine import end_quickly; end_quickly()"
    assert run_python(f"{last}; {quick}", check=True).stdout == "True\n"


def test_a_block_without_collections_leaves_them_as_they_were() -> None:
    try:
        for enabled in (True, False):
            (gc.enable if enabled else gc.disable)()
            with without_collections():
                assert not gc.isenabled()
            assert gc.isenabled() == enabled
    finally:
        gc.enable()
