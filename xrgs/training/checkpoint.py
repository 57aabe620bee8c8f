"""A run's state on disk, so that one that is killed goes on as if it had not been.

What has state says so itself, by `state_dict` and `load_state_dict` as torch's own modules do;
training names those pieces once (`Checkpoint.keep`). The file is a .npz of plain arrays beside one
JSON text: reading one from a stranger runs no code, and numbers come back to the last bit.
"""

from __future__ import annotations

import json
import logging
import time
import zipfile
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch

from xrgs.errors import XrgsError
from xrgs.safeio import npz, untrusted
from xrgs.safeio.atomic import atomic_writer

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

_log = logging.getLogger(__name__)

_PLAIN = "state.json"
"""Member of the archive that holds all that is no tensor, as bytes of UTF-8."""

State = dict[str, Any]
"""Tensors, and values that JSON has, under names; dicts of them may nest. No name has a `/`."""


class CheckpointError(XrgsError):
    """The file is damaged, or of another cell."""


class Stateful(Protocol):
    """A piece of a run that the steps before have changed."""

    def state_dict(self) -> State:
        """What the steps so far have made of it. Tensors are not copied."""

    def load_state_dict(self, state: State) -> None:
        """Become what `state_dict` told of, in one built from the same config and data.

        Raises:
            KeyError: something is missing.
            TypeError: something is of another kind.
            ValueError: something does not fit.
        """


class Checkpoint:
    """The file in which a run keeps the state of its pieces, written every so often."""

    def __init__(self, file: Path | None = None, cell: str = "", every_s: float = 0.0) -> None:
        """Nothing is read yet.

        Args:
            file: Where; None keeps nothing.
            cell: Which program it is the state of. Another's is refused.
            every_s: Seconds between two writes; 0 never writes.
        """
        self.file = file
        self.cell = cell
        self.every_s = every_s
        self._pieces: dict[str, Stateful] = {}
        self._left: State = {}
        self._written = time.monotonic()

    def read(self) -> int | None:
        """Hold ready what a run before left, for the pieces that `keep` names.

        Returns:
            The number of steps done; None where nothing was left.

        Raises:
            CheckpointError: the file is damaged, or of another cell; the message names it.
        """
        self._left = {}
        if self.file is None or not self.file.exists():
            return None
        try:
            state = _load(self.file)
            cell, steps, pieces = state["cell"], int(state["steps"]), dict(state["pieces"])
        except Exception as error:  # whatever a stranger's bytes may lead to
            raise CheckpointError(f"{self.file}: {type(error).__name__}: {error}") from error
        if cell != self.cell:
            raise CheckpointError(f"{self.file}: of cell {cell}, not of {self.cell}")
        self._left = pieces
        return steps

    def keep(self, **pieces: Stateful) -> None:
        """Name the pieces that have state, in place of those of the same name.

        Each takes what a run before left under its name, the first time that the name is given.

        Raises:
            CheckpointError: what was left does not fit; the pieces are of no more use.
        """
        self._pieces |= pieces
        for name, piece in pieces.items():
            if name not in self._left:
                continue
            try:
                piece.load_state_dict(self._left.pop(name))
            except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
                raise CheckpointError(
                    f"{self.file}: {name}: {type(error).__name__}: {error}"
                ) from error

    def after_step(self, number: int) -> float:
        """Write if it is time. A disk that is full or gone costs the checkpoint, not the run.

        Args:
            number: Of the step that is done, from 0.

        Returns:
            Seconds that it took.
        """
        start = time.monotonic()
        if self.file is None or self.every_s <= 0 or start - self._written < self.every_s:
            return 0.0
        pieces = {name: piece.state_dict() for name, piece in self._pieces.items()}
        try:
            _save(self.file, {"cell": self.cell, "steps": number + 1, "pieces": pieces})
        except OSError as error:
            _log.warning("no checkpoint at step %d: %s", number + 1, error)
        self._written = time.monotonic()
        return self._written - start

    def refuse(self) -> None:
        """Move the file aside, so that training starts over, and forget what it held."""
        self._left, self._pieces = {}, {}
        if self.file is not None and self.file.exists():
            self.file.replace(self.file.with_name(f"refused-{self.file.name}"))


def _save(file: Path, state: State) -> None:
    arrays: dict[str, NDArray[Any]] = {}
    text = json.dumps(_without_tensors(state, "", arrays))
    arrays[_PLAIN] = np.frombuffer(text.encode(), np.uint8)
    with atomic_writer(file) as stream, zipfile.ZipFile(stream, "w") as archive:
        for name, array in arrays.items():
            with archive.open(name, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def _without_tensors(state: State, path: str, arrays: dict[str, NDArray[Any]]) -> State:
    """The plain values, as JSON has them; tensors go into `arrays` by their path."""
    plain: State = {}
    for name, value in state.items():
        if isinstance(value, torch.Tensor):
            arrays[path + name] = value.detach().numpy()
        elif isinstance(value, dict):
            plain[name] = _without_tensors(value, f"{path}{name}/", arrays)
        else:
            plain[name] = value
    return plain


def _load(file: Path) -> State:
    with untrusted.open_regular(file) as stream:
        arrays = npz.read(stream)
    state: State = untrusted.parse_json(arrays.pop(_PLAIN).tobytes())
    _with_tensors(state, arrays)
    return state


def _with_tensors(state: State, arrays: Mapping[str, NDArray[Any]]) -> None:
    for path, array in arrays.items():
        *folders, name = path.split("/")
        place = state
        for folder in folders:
            place = place[folder]
        # In memory of torch's own alignment, on which the order of a vectorised sum may depend.
        place[name] = torch.from_numpy(array).clone()
