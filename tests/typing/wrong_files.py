"""Ways to reach files that tests/typing/file_access.py refuses in the package; mypy's input."""

import pathlib
from pathlib import Path, PosixPath

from xrgs.experiment.store import Store
from xrgs.safeio.confined import ConfinedPath, confined


def by_every_way(path: Path, either: Path | ConfinedPath, store: Store) -> None:
    """Use methods of paths; each line that is refused says so."""
    path.read_text()  # refused: read_text
    (path / "name").open()  # refused: open
    pathlib.Path("name").exists()  # refused: exists
    PosixPath("name").unlink()  # refused: unlink
    store.path.joinpath("cells").iterdir()  # refused: iterdir
    either.exists()  # refused: exists
    [inner.stat() for inner in path.glob("*")]  # refused: stat, glob
    if isinstance(either, Path):
        either.mkdir()  # refused: mkdir
    else:
        either.make_folder()
    confined(either).exists()
    store.cells_folder.iterdir()
    (store.cells_folder / "a").open().close()
    path.with_name("b").relative_to(path)
