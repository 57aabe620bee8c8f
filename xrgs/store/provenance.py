"""Records where, when and with which software a cell is run, to explain its numbers later."""

from __future__ import annotations

import platform
import re
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import xrgs
from xrgs.evaluation.lpips import weights
from xrgs.runtime.machine import usable_cores
from xrgs.safeio.records import read_struct
from xrgs.splat.backend import arithmetic, device
from xrgs.store import commit
from xrgs.store.schema import Provenance

_PACKAGES = ("torch", "numpy", "pycolmap", "kornia", "scikit-image", "hydra-core", "pandas")
#: The fields that a cell's times depend on, apart from the program.
MACHINE_KEYS = ("cpu", "gpu", "instruction_set", "threads", "backend")


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _instruction_set(backend: str) -> str | None:
    """Return the instruction set of the native kernels; None for others, which choose their own."""
    if backend != "native":
        return None
    from xrgs import _native

    return str(_native.isa())


def collect(threads: int, backend: str) -> Provenance:
    """Return the program, its libraries, the machine and the time.

    Raises:
        WeightsError: The weights of LPIPS on this machine are not the published ones. A cell that
            can't be scored is better stopped here than after its training.
        XrgsError: The backend is not available on this machine.
    """
    package = Path(xrgs.__file__).parent
    built_from = commit.of_checkout(package.parent) or {}
    if not built_from and (package / commit.FILE).is_file():
        built_from = read_struct(package / commit.FILE, dict[str, str | None])
    gpu: str | None = None
    if device(backend) == "cuda":
        import torch

        gpu = torch.cuda.get_device_name()
    published = weights.load_published()
    return Provenance(
        xrgs=xrgs.__version__,
        git=built_from.get("git"),
        git_diff_sha256=built_from.get("git_diff_sha256"),
        python=sys.version.split()[0],
        packages={name: metadata.version(name) for name in _PACKAGES},
        platform=platform.platform(),
        cores=usable_cores(),
        threads=threads,
        backend=backend,
        arithmetic=arithmetic(backend),
        lpips_weights_sha256=None if published is None else weights.CONTENT_SHA256,
        started=datetime.now(UTC).isoformat(timespec="seconds"),
        cpu=_cpu(),
        gpu=gpu,
        instruction_set=_instruction_set(backend),
    )


def machine(made: Provenance) -> str:
    """Return the machine in words, for example `AMD EPYC, avx2, threads 1, native`."""
    parts = (made.cpu, made.gpu, made.instruction_set, f"threads {made.threads}", made.backend)
    return ", ".join(filter(None, parts))


def without_threads(name: str) -> str:
    """Return the name of a machine, as `machine` gives it, without the number of threads."""
    return re.sub(r", threads \d+", "", name)


def processor(made: Provenance) -> str:
    """Return the processor that trained a cell, for example `AMD EPYC, avx2`.

    The text is empty where several machines have trained the cell in turn.
    """
    return "" if made.machines_in_turn else _processor(made.cpu, made.instruction_set)


@cache
def this_processor(backend: str) -> str:
    """Return the processor of this machine, named as by `processor`."""
    return _processor(_cpu(), _instruction_set(backend))


def _processor(cpu: str | None, instruction_set: str | None) -> str:
    return ", ".join(filter(None, (cpu, instruction_set)))


class Machines:
    """The names of the machines that train a cell in turn; the checkpoint keeps them."""

    def __init__(self, here: str) -> None:
        """Begin with the machine of this process, `here`, see `machine`."""
        self.names = [here]

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint."""
        return {"names": self.names}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put the machines of a checkpoint, which trained before, in front of this one."""
        before = state["names"]
        if not isinstance(before, list) or not all(isinstance(name, str) for name in before):
            raise TypeError(f"names: {before!r:.40} must be a list of texts")
        self.names = list(dict.fromkeys([*before, *self.names]))
