"""What makes two cells the same cell: everything that can change a number, and nothing else.

Paths, thread counts, logging and labels are not in it, so a finished cell is found again under
another name, in another folder or on another machine.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from xrgs.evaluation.protocol import PROTOCOL
from xrgs.safeio.hashing import plain, source_digests
from xrgs.splat.backend import resolve_backend

if TYPE_CHECKING:
    from xrgs.config import Conf

#: Files whose change can change a trained number; of folders, every source file inside.
_TRAINING_CODE = (
    "splat",
    "training",
    "capture/dataset.py",
    "evaluation/lpips/network.py",
    "evaluation/lpips/weights.py",
    "evaluation/metrics.py",
    "evaluation/protocol.py",
    "safeio/npz.py",
)
#: What the native backend is compiled from, shipped beside it: two builds of it are not the same
#: bytes, and not another program.
_NATIVE_CODE = "csrc"


@cache
def training_code(backend: str) -> dict[str, str]:
    """SHA-256 of each source file that trains with a backend, keyed by its path in the package."""
    names = (*_TRAINING_CODE, _NATIVE_CODE) if backend == "native" else _TRAINING_CODE
    return source_digests(*names)


def cell_identity(conf: Conf, variant_id: str) -> dict[str, Any]:
    """Everything that decides a cell's numbers, as plain JSON values."""
    backend = resolve_backend(conf.splat.backend)
    return {
        "splat": plain(conf.splat) | {"backend": backend},
        "train": plain(conf.train),
        "components": plain(conf.components),
        "seed": conf.seed,
        "variant": variant_id,
        "protocol": PROTOCOL,
        "code": training_code(backend),
    }
