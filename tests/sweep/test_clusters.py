"""Tests of sweeps on a SLURM and a Ray cluster of two nodes, which run on this machine."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
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
if "xrgs.sweep.jobs.worker" in sys.orig_argv and "cell" in sys.orig_argv:
    folder = Path(os.environ["SWEEPS_OF"])
    end = time.monotonic() + 240
    while len(list((folder / "s" / "cells").glob("*/identity.json"))) < 2:
        if time.monotonic() > end:
            os._exit(3)
        time.sleep(0.05)
    if json.loads(Path(sys.orig_argv[-2]).read_text())["conf"]["seed"] == 1:
        job = os.environ["SLURM_ARRAY_JOB_ID"] + "_" + os.environ["SLURM_ARRAY_TASK_ID"]
        (folder / "job.new").write_text(job)
        (folder / "job.new").rename(folder / "job")
        time.sleep(600)
"""
#: Two nodes of Ray, until standard input ends.
RAY = """
import sys
from ray.cluster_utils import Cluster

head = {"num_cpus": 1, "include_dashboard": False}
cluster = Cluster(True, head_node_args=head)
cluster.add_node(num_cpus=1)
print(cluster.address, flush=True)
sys.stdin.read()
cluster.shutdown()
"""


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
def ray_address(tmp_path: Path) -> Iterator[str]:
    """The address of a Ray cluster of two nodes of one core each."""
    if find_spec("hydra_plugins.hydra_ray_launcher") is None:
        pytest.skip("pip install 'xrgs[ray]', which is large")
    with (tmp_path / "ray").open("w") as log:
        cluster = subprocess.Popen(
            [sys.executable, "-c", RAY],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
        with cluster:  # closes its pipes and waits for its end
            assert cluster.stdout is not None
            address = cluster.stdout.readline().strip()
            assert ":" in address, (tmp_path / "ray").read_text()
            yield address


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
    address = f"hydra.launcher.ray.init.address='{ray_address}'"
    code, out, err = sweeps_in(tmp_path).run(*SMOKE, "hydra/launcher=ray", address)
    assert code == 0, err
    assert "PSNR" in out
