"""The identity of a cell: every value that can change one of its trained numbers, nothing else.

1. Words don't count: comments, docstrings and blank lines of the code change no id.
2. What is off is absent: a component that is off, its settings and its module are not in the
   identity, nor is any key at its `off` value (`xrgs.config.off`).
3. The module of a component counts where the component is on, and so does the code of a dense
   start. The core counts always, and the native kernels count where the native backend trains.
4. Scores are apart: metrics and the evaluation protocol have digests of their own
   (`xrgs.evaluation.scoring`), and `xrgs-store rescore` makes scores anew.
5. A refactoring that changes no number keeps its cells: `xrgs-store prove` trains a sample of cells
   again, and declares the digests of the old and the new code equal where all bits are.
6. Any other change of the hashed code makes new ids.

Paths, thread counts, logging and labels are not part of it, so that a finished cell is found again
under another label, in another folder or on another machine. Of a machine the identity has the
arithmetic (`xrgs.splat.backend.arithmetic`): the native backend gives the same bits on all machines
of the same arithmetic. The last digits of the torch backend differ among machines, and this is not
part of it. Of the gsplat backend it has the version of gsplat.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import msgspec

from xrgs import plugins
from xrgs.config import identity_values
from xrgs.registry import modules_of, order_of
from xrgs.safeio.code import code_digest
from xrgs.safeio.hashing import digest
from xrgs.safeio.refactorings import canonical
from xrgs.splat.backend import arithmetic, check_raster, resolve_backend
from xrgs.store.schema import Identity

if TYPE_CHECKING:
    from xrgs.config import Conf

#: Source files whose change can change a trained number, whatever components are on.
CORE = (
    "training/dataset.py",
    "safeio/npz.py",
    "splat/attribution.py",
    "splat/backend.py",
    "splat/bicubic.py",
    "splat/cameras.py",
    "splat/gaussians.py",
    "splat/loss.py",
    "splat/native",
    "splat/normalize.py",
    "splat/optimizer.py",
    "splat/quaternions.py",
    "splat/rendering.py",
    "splat/resample.py",
    "splat/rounding.py",
    "splat/settings.py",
    "splat/sh.py",
    "splat/ssim.py",
    "splat/strategy/__init__.py",
    "splat/strategy/base.py",
    "splat/strategy/default.py",
    "splat/strategy/mcmc.py",
    "splat/strategy/ops.py",
    "splat/strategy/refinement.py",
    "splat/torch",
    "training/checkpoint.py",
    "training/components/__init__.py",
    "training/components/base.py",
    "training/components/combined.py",
    "training/count_matching.py",
    "training/loop.py",
    "training/memory.py",
    "training/recorder.py",
    "training/rendering.py",
    "training/sampler.py",
    "training/seeding.py",
    "training/work.py",
)
#: Files that count on one backend only. Of the native one these are the C++ sources, and not the
#: compiled module: two builds of the same sources differ in their bytes and give the same numbers.
BACKEND_CODE = {"native": ("csrc",), "gsplat": ("splat/gsplat",)}
#: The code that places the first Gaussians, by the values of `splat.init`; that of others is core.
START_CODE = {"dense": ("training/dense",)}


def cell_identity(conf: Conf, variant_id: str) -> Identity:
    """Return everything that decides a cell's trained numbers; its digest is the cell's id.

    Args:
        conf: The cell's config.
        variant_id: The id of the frozen variant that the cell trains on.

    Raises:
        XrgsError: The configured backend is not available on this machine, or can't render with
            these settings, or a plugin is missing.
    """
    backend = resolve_backend(conf.splat.backend)
    check_raster(backend, conf.splat.raster)
    components = identity_values(conf.components)
    return Identity(
        variant=variant_id,
        seed=conf.seed,
        train=identity_values(conf.train),
        splat=identity_values(conf.splat) | {"backend": backend},
        components=components,
        arithmetic=arithmetic(backend),
        code=training_code(
            backend, tuple(components), tuple(sorted(conf.components.plugins)), conf.splat.init
        ),
    )


def cell_id(identity: Identity) -> str:
    """Return the id of a cell: 16 hexadecimal digits."""
    return digest(msgspec.to_builtins(identity))


@cache
def training_code(
    backend: str,
    components: tuple[str, ...] = (),
    plugin_names: tuple[str, ...] = (),
    init: str = "sfm",
) -> dict[str, str]:
    """Return the digest of each part of the code that trains a cell; files are read once.

    Args:
        backend: `native`, `torch` or `gsplat`.
        components: Keys of the components that are on.
        plugin_names: Names of components of other packages, sorted.
        init: `splat.init` of the config.

    Raises:
        XrgsError: A plugin is not installed, or has no source file.
    """
    return code_now(backend, components, plugin_names, init)


def code_now(
    backend: str,
    components: tuple[str, ...] = (),
    plugin_names: tuple[str, ...] = (),
    init: str = "sfm",
) -> dict[str, str]:
    """Return `training_code` of the files as they are now, edited meanwhile or not."""
    files = _files(backend, components, init)
    code = {part: canonical(part, code_digest(*names)) for part, names in files.items()}
    if order := order_of(components):  # of the components' hooks
        code["order"] = order
    return code | {f"plugins/{name}": plugins.code_digest(name) for name in plugin_names}


def _files(backend: str, components: tuple[str, ...], init: str) -> dict[str, tuple[str, ...]]:
    """Return the source files of each part of the code, relative to the package."""
    files: dict[str, tuple[str, ...]] = {"core": CORE}
    if backend in BACKEND_CODE:
        files[backend] = BACKEND_CODE[backend]
    if init in START_CODE:
        files[init] = START_CODE[init]
    return files | {key: modules_of(key) for key in components if modules_of(key)}


def changed_code(identity: Identity, *, cached: bool = False) -> list[str]:
    """Return the parts of the installed code that differ from those of an identity, sorted.

    Args:
        identity: The identity of a cell.
        cached: Take the digests that this process has computed before. Otherwise every file is read
            as it is now: it may have been edited while a sweep runs.

    Raises:
        XrgsError: A plugin is not installed.
    """
    now = current_code(identity, cached=cached)
    trained = {part: canonical(part, code) for part, code in identity.code.items()}
    parts = trained.keys() | now.keys()
    return sorted(part for part in parts if trained.get(part) != now.get(part))


def current_code(identity: Identity, *, cached: bool = False) -> dict[str, str]:
    """Return the digests that the parts of an identity's code have in the installed package."""
    names = tuple(sorted(identity.components.get("plugins", {})))
    code = training_code if cached else code_now
    init = str(identity.splat.get("init", "sfm"))
    return code(str(identity.splat["backend"]), tuple(identity.components), names, init)
