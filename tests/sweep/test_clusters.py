"""Tests of sweeps on a SLURM and a Ray cluster of two nodes, which run on this machine."""

from __future__ import annotations

import os
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

CLUSTER = Path(__file__).parents[2] / ".ci" / "slurm"
SMOKE = ("scene=motorcycle", "preset=smoke", "train.steps=4", "seed=0,1")
SLURM = ("hydra/launcher=submitit_slurm", "hydra.launcher.partition=cpu")
#: Python loads this in every process of a sweep: each sees two cores, so that a node has room for
#: one cell. A cell waits for the other one, and the second one is at work until its job is killed.
SITE = """
import json, os, sys, time
from pathlib import Path

os.sched_getaffinity = lambda pid: {0, 1}
if "xrgs.sweep.job" in sys.orig_argv and "cell" in sys.orig_argv:
    folder = Path(os.environ["SWEEPS_OF"])
    end = time.monotonic() + 240
    while len(list((folder / "s" / "cells").glob("*/log.txt"))) < 2:
        if time.monotonic() > end:
            os._exit(3)
        time.sleep(0.05)
    cell = Path(json.loads(Path(sys.orig_argv[-2]).read_text())["cell"])
    if json.loads((cell / "config.json").read_text())["seed"] == 1:
        job = os.environ["SLURM_ARRAY_JOB_ID"] + "_" + os.environ["SLURM_ARRAY_TASK_ID"]
        (folder / "job.new").write_text(job)
        (folder / "job.new").rename(folder / "job")
        time.sleep(600)
"""
#: The same in every process of the nodes of Ray: a cell waits until another one has begun.
RAY_SITE = """
import os, sys, time
from pathlib import Path

if "xrgs.sweep.job" in sys.orig_argv and "cell" in sys.orig_argv:
    end = time.monotonic() + 240
    while len(list(Path({store!r}, "cells").glob("*/log.txt"))) < 2:
        if time.monotonic() > end:
            os._exit(3)
        time.sleep(0.05)
"""
#: Seconds that Ray may take for its nodes on a machine that does much else.
RAY_S = 240
#: Ports of a node of Ray. Where they are not given, its raylet waits for its agents to choose them,
#: and ends itself when that takes longer than 15 s.
PORTS = ("metrics-export", "dashboard-agent-grpc", "dashboard-agent-listen", "runtime-env-agent")


@pytest.fixture(scope="module")
def slurm() -> Iterator[None]:
    """A SLURM cluster of two nodes of two cores each, which SLURM's commands find."""
    if shutil.which("slurmctld") is None:
        pytest.skip("there is no SLURM here: .ci/slurm install")
    if os.geteuid() != 0:
        pytest.skip("the nodes of .ci/slurm need root")
    with tempfile.TemporaryDirectory(prefix="xrgs-slurm-") as folder:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        changes = {"SLURM_PORT": str(port), "SLURM_CORES": "2"}
        try:
            subprocess.run([CLUSTER, "start", folder], env=os.environ | changes, check=True)
            with pytest.MonkeyPatch.context() as patch:
                patch.setenv("SLURM_CONF", f"{folder}/slurm.conf")
                yield
        finally:
            subprocess.run([CLUSTER, "stop", folder], check=True)


@pytest.fixture
def ray_address(
    tmp_path: Path, sweeps_in: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> Iterator[str]:
    """The address of a Ray cluster of two nodes, each of which has one core for cells."""
    if find_spec("hydra_plugins.hydra_ray_launcher") is None:
        pytest.skip("pip install 'xrgs[ray]', which is large")
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(32))
    (tmp_path / "sitecustomize.py").write_text(RAY_SITE.format(store=str(tmp_path / "s")))
    path = os.pathsep.join(filter(None, [str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    changes = {"PYTHONPATH": path, "SWEEPS_OF": str(tmp_path / "ray")}
    changes["RAY_worker_register_timeout_seconds"] = str(RAY_S)
    ports = free_ports(1 + 2 * len(PORTS))
    # The paths of its sockets may have at most 107 bytes.
    with tempfile.TemporaryDirectory(prefix="xrgs-ray-") as folder, ExitStack() as nodes:
        head = ("--head", f"--port={ports[0]}", "--include-dashboard=false", f"--temp-dir={folder}")
        nodes.enter_context(ray_node(tmp_path / "head", head, ports[1::2], changes))
        address = Path(folder, "ray_current_cluster").read_text().strip()
        other = (f"--address={address}",)
        nodes.enter_context(ray_node(tmp_path / "other", other, ports[2::2], changes))
        yield address
        nodes.close()
        sweeps_in(tmp_path / "ray").leave_nothing_running()


def free_ports(count: int) -> list[int]:
    with ExitStack() as held:
        free = [held.enter_context(socket.socket()) for _ in range(count)]
        for each in free:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in free]


@contextmanager
def ray_node(
    printed: Path, options: Sequence[str], ports: Sequence[int], changes: dict[str, str]
) -> Iterator[None]:
    """Start a node of Ray; at the end, end it and all processes of it."""
    given = [f"--{name}-port={port}" for name, port in zip(PORTS, ports, strict=True)]
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", "--block", "--num-cpus=1"]
    with printed.open("wb") as out:
        node = subprocess.Popen(
            [*command, "--disable-usage-stats", *options, *given],
            env=os.environ | changes,
            stdout=out,
            stderr=out,
        )
    try:
        end = time.monotonic() + RAY_S
        while "Ray runtime started." not in printed.read_text():
            assert node.poll() is None, printed.read_text()
            assert time.monotonic() < end, printed.read_text()
            time.sleep(0.1)
        yield
    finally:
        node.terminate()  # ends its processes before itself
        try:
            node.wait(60)
        except subprocess.TimeoutExpired:
            node.kill()  # Linux ends them with it
            node.wait()


def wait_for(file: Path, process: subprocess.Popen[bytes]) -> str:
    end = time.monotonic() + 240
    while not file.exists():
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.05)
    return file.read_text()


@pytest.mark.usefixtures("slurm")
def test_a_cancelled_job_of_slurm_is_its_own_cell_s_loss_and_the_next_sweep_continues_it(
    tmp_path: Path, sweeps_in: Callable[..., Any]
) -> None:
    sweeps = sweeps_in(tmp_path, SITE)
    sweep = sweeps.start(*SMOKE, *SLURM, "hydra.launcher.cpus_per_task=2")
    job = wait_for(tmp_path / "job", sweep.process)
    subprocess.run(["scancel", job], check=True)  # noqa: S607  # of the SLURM under test
    code, out, err = sweep.end()
    sweeps.leave_nothing_running()
    assert code == 1, err
    assert "PSNR" in out
    assert "seed 1: its job was asked to end; the next sweep continues it" in err
    done, left = (sweeps.cells()[seed] for seed in (0, 1))
    assert (done / "status.json").exists()
    assert not (left / "status.json").exists()
    assert "begun and not done yet" in out
    assert not list((tmp_path / "s" / "locks").iterdir())
    code, out, err = sweeps.run(*SMOKE, *SLURM, faults=False)
    assert code == 0, err
    assert "plan: 2 cells, 1 done" in err
    assert (left / "status.json").exists()


@pytest.mark.usefixtures("slurm")
def test_a_partition_that_slurm_does_not_have_ends_the_sweep_with_sbatch_s_words(
    tmp_path: Path, sweeps_in: Callable[..., Any]
) -> None:
    code, _, err = sweeps_in(tmp_path).run(*SMOKE, *SLURM, "hydra.launcher.partition=none")
    assert code == 1
    assert "invalid partition specified: none" in err
    assert "The launcher began no cell." in err


def test_the_nodes_of_a_ray_cluster_share_the_cells(
    tmp_path: Path, sweeps_in: Callable[..., Any], ray_address: str
) -> None:
    """Each cell waits for the other one to begin, and a node has room for one."""
    sweeps = sweeps_in(tmp_path)
    address = f"hydra.launcher.ray.init.address='{ray_address}'"
    code, out, err = sweeps.run(*SMOKE, "hydra/launcher=ray", address)
    assert code == 0, err
    assert "hydra/launcher=ray: 2 cells, threads=1 each" in err
    assert "PSNR" in out
    assert all((sweeps.cells()[seed] / "status.json").exists() for seed in (0, 1))
