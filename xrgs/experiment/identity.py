"""The identity of a cell: every value that can change one of its numbers, and nothing else.

Paths, thread counts, logging and labels are not part of it, so a finished cell is found again under
another label, in another folder or on another machine. Of a machine it has the arithmetic
(`xrgs.splat.backend.arithmetic`): the native backend gives the same bits on all machines of the
same arithmetic. The last digits of the torch backend differ among machines, and this is not part of
it.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from xrgs.evaluation.protocol import PROTOCOL_VERSION
from xrgs.safeio.hashing import source_digests, to_plain
from xrgs.splat.backend import arithmetic, resolve_backend
from xrgs.training import plugins

if TYPE_CHECKING:
    from collections.abc import Mapping

    from xrgs.config import Conf

#: Files whose change can change a trained number; a folder stands for every source file inside.
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
#: The C++ sources of the native backend. The compiled module itself is not hashed: two builds of
#: the same sources differ in their bytes and give the same numbers.
_NATIVE_CODE = "csrc"


@cache
def training_code(backend: str, plugin_names: tuple[str, ...] = ()) -> dict[str, str]:
    """Return the SHA-256 of each source file that trains with a backend; they are read once.

    All cells of the same backend and plugins share the returned object: a plan of ten thousand
    cells would else hold as many copies.

    Args:
        backend: `native` or `torch`.
        plugin_names: The names of components of other packages, sorted.

    Returns:
        The digests, keyed by the file's path in the package; those of other packages by
        `plugins/<name>/<path in the package>`.

    Raises:
        XrgsError: A plugin is not installed, or has no source file.
    """
    digests = _installed_code(backend)
    for name in plugin_names:
        digests |= plugins.source_digests(name)
    return digests


def _installed_code(backend: str) -> dict[str, str]:
    names = (*_TRAINING_CODE, _NATIVE_CODE) if backend == "native" else _TRAINING_CODE
    return source_digests(*names)


def changed_code(code: Mapping[str, str], backend: str) -> list[str]:
    """Return the source files that are not the ones that an identity was computed with.

    The installed files are read anew, so that a file edited since this process started counts too.

    Args:
        code: The `code` of an identity.
        backend: `native` or `torch`.

    Returns:
        Paths in the package of files that were changed, added or removed; sorted.
    """
    installed = _installed_code(backend) | plugins.digests_now(code)
    files = code.keys() | installed.keys()
    return sorted(file for file in files if code.get(file) != installed.get(file))


def cell_identity(conf: Conf, variant_id: str) -> dict[str, Any]:
    """Return everything that decides a cell's numbers, as plain JSON values.

    Args:
        conf: The cell's config.
        variant_id: The id of the frozen variant that it trains on.

    Returns:
        The identity. Its digest is the cell's id.

    Raises:
        XrgsError: The backend that is configured is not available on this machine.
    """
    backend = resolve_backend(conf.splat.backend)
    return {
        "splat": to_plain(conf.splat) | {"backend": backend},
        "train": to_plain(conf.train),
        "components": to_plain(conf.components),
        "seed": conf.seed,
        "variant": variant_id,
        "protocol": PROTOCOL_VERSION,
        "arithmetic": arithmetic(backend),
        "code": training_code(backend, tuple(sorted(conf.components.plugins))),
    }
