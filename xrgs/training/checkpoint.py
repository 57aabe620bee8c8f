"""The state of a training run on disk, from which a killed run continues with the same result.

Each object that the steps change has `state_dict` and `load_state_dict`, as torch's modules; a run
registers these objects once (`Checkpoint.register`). The file is a .npz of plain arrays and a JSON
text: reading a file of unknown origin runs no code, and numbers are exact to the last bit.
"""

from __future__ import annotations

import json
import logging
import time
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch

from xrgs.errors import XrgsError
from xrgs.safeio import npz
from xrgs.safeio.atomic import atomic_writer

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

_log = logging.getLogger(__name__)

_JSON_MEMBER = "state.json"
"""Member of the archive with all values except tensors, as JSON in UTF-8."""

State = dict[str, Any]
"""Name -> tensor, JSON value or another such dict. No name contains `/`."""


class CheckpointError(XrgsError):
    """The file is damaged, or belongs to another cell."""


class Stateful(Protocol):
    """An object of a run that the steps change."""

    def state_dict(self) -> State:
        """Return the state. Tensors are not copied."""

    def load_state_dict(self, state: State) -> None:
        """Restore the state of an object that was built from the same config and data.

        Raises:
            KeyError: An entry is missing.
            TypeError: An entry is of another type.
            ValueError: An entry does not fit.
        """


class Checkpoint:
    """Writes the state of the registered objects to a file at an interval, and restores it."""

    def __init__(self, file: Path | None = None, cell_id: str = "", every_s: float = 0.0) -> None:
        """Set the file of the cell in training, and the seconds between two writes.

        None as file and 0 seconds write nothing. The file of another cell is refused.
        """
        self.file, self.cell_id, self.every_s = file, cell_id, every_s
        self._objects: dict[str, Stateful] = {}
        self._loaded: State = {}
        """States that `load` has read, of objects that are not registered yet."""
        self._written_at = time.monotonic()

    def load(self) -> int | None:
        """Read the file, and return the number of steps done; None if there is no file.

        Each object's state is restored when the object is registered.

        Raises:
            CheckpointError: The file is damaged, or belongs to another cell; the message names the
                file.
        """
        self._loaded = {}
        if self.file is None or not self.file.exists():
            return None
        try:
            state = _load(self.file)
            cell_id, steps, states = state["cell"], int(state["steps"]), dict(state["states"])
        except Exception as error:  # a damaged file may raise any error
            raise CheckpointError(f"{self.file}: {type(error).__name__}: {error}") from error
        if cell_id != self.cell_id:
            raise CheckpointError(f"{self.file}: belongs to cell {cell_id}, not to {self.cell_id}")
        self._loaded = states
        return steps

    def register(self, **objects: Stateful) -> None:
        """Add objects whose state is written; they replace registered objects of the same names.

        States that `load` has read are restored, in the order of the objects.

        Raises:
            CheckpointError: A state is missing or does not fit its object. The objects may be half
                restored, and must not be used.
        """
        self._objects |= objects
        if not self._loaded:
            return
        for name, value in objects.items():
            try:
                value.load_state_dict(self._loaded.pop(name))
            except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
                raise CheckpointError(
                    f"{self.file}: {name}: {type(error).__name__}: {error}"
                ) from error

    def save_if_due(self, step: int) -> float:
        """Write the file after step `step`, from 0, if the interval has passed.

        If the file can't be written, a warning is logged and training continues.

        Returns:
            The time of writing, seconds.
        """
        start = time.monotonic()
        if self.file is None or self.every_s <= 0 or start - self._written_at < self.every_s:
            return 0.0
        states = {name: value.state_dict() for name, value in self._objects.items()}
        try:
            _save(self.file, {"cell": self.cell_id, "steps": step + 1, "states": states})
        except OSError as error:
            _log.warning(
                "%s: no checkpoint was written after step %d (%s); training continues",
                self.file,
                step,
                error,
            )
        self._written_at = time.monotonic()
        return self._written_at - start

    def set_aside(self) -> None:
        """Rename the file to `refused-<name>` and forget its states, so that training restarts."""
        self._loaded, self._objects = {}, {}
        if self.file is not None and self.file.exists():
            self.file.rename(self.file.with_name(f"refused-{self.file.name}"))


def _save(file: Path, state: State) -> None:
    arrays: dict[str, Any] = {}
    text = json.dumps(_split_off_tensors(state, "", arrays))
    arrays[_JSON_MEMBER] = np.frombuffer(text.encode(), np.uint8)
    with atomic_writer(file) as stream:
        np.savez(stream, **arrays)


def _split_off_tensors(state: State, path: str, arrays: dict[str, NDArray[Any]]) -> State:
    """Return the state without tensors; put these into `arrays`, with their path as the key."""
    plain: State = {}
    for name, value in state.items():
        if isinstance(value, torch.Tensor):
            arrays[path + name] = value.detach().cpu().numpy()
        elif isinstance(value, dict):
            plain[name] = _split_off_tensors(value, f"{path}{name}/", arrays)
        else:
            plain[name] = value
    return plain


def _load(file: Path) -> State:
    with file.open("rb") as stream:
        arrays = npz.read(stream)
    state: State = json.loads(arrays.pop(_JSON_MEMBER).tobytes())
    for path, array in arrays.items():
        *folders, name = path.split("/")
        inner = state
        for folder in folders:
            inner = inner[folder]
        # Cloned to get torch's memory alignment: the order of a vectorised sum may depend on it.
        inner[name] = torch.from_numpy(array).clone()
    return state
