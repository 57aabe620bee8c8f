"""The identity of a cell: every value that can change one of its trained numbers, nothing else.

1. Comments, docstrings and blank lines of the code change no id.
2. A component that is off is not in the identity, nor are its settings and its module, nor any key
   at its `off` value (`xrgs.config.off`).
3. The code is every file of `splat/`, `training/` and `csrc/`. Files of a component, a strategy, a
   backend or the dense start count where it is on, and all others always.
4. Scores are apart: metrics and the evaluation protocol have digests of their own
   (`xrgs.store.scoring`), and `xrgs-store rescore` makes scores anew.
5. A refactoring that changes no number keeps its cells: `.ci/prove` trains a sample of cells
   again, and declares the digests of the old and the new code equal where all bits are.
6. Any other change of the hashed code makes new ids.

Paths, thread counts, logging and labels are not part of it, so that a finished cell is found again
under another label, in another folder or on another machine. The arithmetic of the machine
(`xrgs.splat.backend.arithmetic`) is part of it: the native backend gives the same bits on all
machines of one arithmetic. The last digits of the torch backend differ from machine to machine, and
the identity does not tell them apart. For the gsplat backend it has the version of gsplat.
"""

from __future__ import annotations

from functools import cache

import msgspec

from xrgs import plugins
from xrgs.config import Conf, identity_values
from xrgs.registry import BUILT_IN, file_of, order_of
from xrgs.safeio.code import CodeFolders, code_digest
from xrgs.safeio.hashing import digest
from xrgs.safeio.refactorings import ABSENT, canonical
from xrgs.splat.backend import arithmetic, check_raster, resolve_backend
from xrgs.splat.settings import STRATEGIES
from xrgs.store.schema import Identity

#: The code that trains. The files of backends, the dense start, strategies and components count
#: where these are on; every other file counts always.
CODE = CodeFolders(
    folders=("splat", "training"),
    whole_parts=("splat/gsplat", "splat/native", "splat/torch", "training/dense"),
    folders_of_parts=("splat/strategy", "training/components"),
    parts=frozenset(
        {f"splat/strategy/{name}.py" for name in STRATEGIES}
        | {file for key in BUILT_IN if (file := file_of(key))}
    ),
)
#: The parts of each backend. The kernels count by their C++ sources, and not as compiled module:
#: two builds of the same sources differ in their bytes and give the same numbers.
_BACKENDS: dict[str, dict[str, tuple[str, ...]]] = {
    "native": {"native": ("splat/native", "csrc")},
    "torch": {"torch": ("splat/torch",)},
    "gsplat": {"gsplat": ("splat/gsplat",), "torch": ("splat/torch",)},
}
#: `splat.init` -> the code that places the first Gaussians. For other values it is in the core.
_STARTS = {"dense": ("training/dense",)}


def cell_identity(conf: Conf, variant_id: str) -> Identity:
    """Return everything that decides a cell's trained numbers; its digest is the cell's id.

    XrgsError says that the configured backend is not available on this machine, or can't render
    with these settings, or that a plugin is missing.
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
            backend,
            tuple(components),
            tuple(sorted(conf.components.plugins)),
            conf.splat.init,
            conf.splat.strategy,
        ),
    )


def cell_id(identity: Identity) -> str:
    """Return the id of a cell: 16 hexadecimal digits."""
    return digest(msgspec.to_builtins(identity))


def code_now(
    backend: str,
    components: tuple[str, ...] = (),
    plugin_names: tuple[str, ...] = (),
    init: str = "sfm",
    strategy: str = "default",
) -> dict[str, str]:
    """Return the digest of each part of the code that trains a cell, of the files as they are now.

    The components are the keys of those that are on, and the plugins the sorted names of those of
    other packages. XrgsError says that a plugin is not installed, or has no source file.
    """
    files = _files(backend, components, init, strategy)
    code = {part: canonical(part, code_digest(*names)) for part, names in files.items()}
    if order := order_of(components):  # of the components' hooks
        code["order"] = order
    code |= {f"plugins/{name}": plugins.code_digest(name, CODE) for name in plugin_names}
    return {part: digest for part, digest in code.items() if digest != ABSENT}


#: `code_now` of the files as they were at the first call of this process. A plan calls it often.
training_code = cache(code_now)


def _files(
    backend: str, components: tuple[str, ...], init: str, strategy: str
) -> dict[str, tuple[str, ...]]:
    """Return the source files of each part of the code, relative to the package."""
    core = CODE.core()
    files: dict[str, tuple[str, ...]] = {"core": core, **_BACKENDS[backend]}
    if init in _STARTS:
        files[init] = _STARTS[init]
    if strategy in STRATEGIES:  # else the config is refused
        files[f"strategy/{strategy}"] = CODE.part(f"splat/strategy/{strategy}.py", core)
    return files | {key: CODE.part(file, core) for key in components if (file := file_of(key))}


def changed_code(identity: Identity, *, cached: bool = False) -> list[str]:
    """Return the parts of the code that have changed since an identity was made, sorted.

    With `cached`, digests are those that this process has computed before. Otherwise every file is
    read as it is now: it may have been edited while a sweep runs.
    """
    now = current_code(identity, cached=cached)
    trained = {part: canonical(part, code) for part, code in identity.code.items()}
    parts = trained.keys() | now.keys()
    return sorted(part for part in parts if trained.get(part) != now.get(part))


def current_code(identity: Identity, *, cached: bool = False) -> dict[str, str]:
    """Return the digests, in the installed package, of the parts of code that an identity needs."""
    names = tuple(sorted(identity.components.get("plugins", {})))
    code = training_code if cached else code_now
    init = str(identity.splat.get("init", "sfm"))
    strategy = str(identity.splat.get("strategy", "default"))
    backend = str(identity.splat["backend"])
    return code(backend, tuple(identity.components), names, init, strategy)
