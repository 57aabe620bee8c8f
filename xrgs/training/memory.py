"""The memory of training: limits the cache of SSIM statistics, and measures the peak."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from xrgs.splat.settings import KEPT_BYTES

if TYPE_CHECKING:
    from xrgs.splat.rendering import Render
    from xrgs.training.checkpoint import State
    from xrgs.training.components.base import Step, TrainingView

T = TypeVar("T")
_CODE = (type, ModuleType, FunctionType)


class OnDemand(Mapping[str, T]):
    """View name -> a tensor or an object with tensors, cached as far as memory allows.

    The values of the first views are cached, up to `KEPT_BYTES`; the others are made at each
    access. The order of the views does not matter, since training draws them at random.

    Attributes:
        make: Makes a value. `TrainingMemory` also counts tensors that this function holds.
        kept: View name -> cached value.
    """

    def __init__(self, make: Callable[[TrainingView], T], views: Iterable[TrainingView]) -> None:
        """Make the cached values by `make`; the names of the views are unique."""
        self.make = make
        self._views = {view.name: view for view in views}
        self.kept: dict[str, T] = {}
        room = KEPT_BYTES
        for name, view in self._views.items():
            value = make(view)
            room -= sum(_storages(tensors_in(value)).values())
            if room < 0:
                break
            self.kept[name] = value

    def __getitem__(self, name: str) -> T:
        return self.kept[name] if name in self.kept else self.make(self._views[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._views)

    def __len__(self) -> int:
        return len(self._views)


class TrainingMemory:
    """Measures the peak memory of a training step, bytes.

    A step's memory is the sum of

    - the model, its gradients and the optimizer's state,
    - the statistics of densification,
    - the 8-bit photographs, their cached SSIM statistics, and the target of the step's view,
    - the tensors of the components,
    - the tensors that autograd saves from the forward to the backward pass,
    - the buffers of the renderer.

    Tensors that share their memory count once. Temporary tensors within the forward and the
    backward pass do not count. On a GPU the count is torch's peak of allocated memory there.

    Steps of the same kind use the same memory: the same number of Gaussians and harmonics, and a
    view of the same size and tag, with cached statistics or without. Only the first step of each
    kind is measured.

    Attributes:
        largest_bytes: The largest count so far.
    """

    def __init__(self, *holders: object, device: str = "cpu") -> None:
        """Start with nothing counted.

        Args:
            holders: Objects that hold tensors throughout training, in their attributes or items.
            device: Device of the training tensors, `cpu` or `cuda`.
        """
        self.holders = holders
        self.device = device
        if device == "cuda":
            torch.cuda.reset_peak_memory_stats()
        self.largest_bytes = 0
        self._counted: set[str] = set()
        self._noted: tuple[str, int] | None = None
        """Kind of the measured step, and the size of the tensors that autograd saved, bytes."""

    @contextmanager
    def of_forward(
        self, step: Step, gaussians: int, sh_degree: int, *, kept: bool = True
    ) -> Iterator[None]:
        """Measure the tensors that autograd saves in the forward pass, once for each kind of step.

        Besides the step, its number of Gaussians, the highest rendered band of the spherical
        harmonics and whether the SSIM statistics of its photograph are `kept` are its kind.
        """
        camera, logged = step.view.camera, sorted(step.log.items())
        size = f"{camera.width} x {camera.height} px"
        kind = f"{gaussians} {sh_degree} {step.view.tag} {size} {kept} {logged}"
        self._noted = None
        # No hooks on a GPU: with hooks, gsplat 1.5.3 loses the gradients of its `absgrad`.
        if kind in self._counted or self.device == "cuda":
            yield
            return
        packed: list[weakref.ref[Tensor]] = []

        def note(tensor: Tensor) -> Tensor:
            kept = tensor.detach()  # returning the tensor itself would create a reference cycle
            packed.append(weakref.ref(kept))
            return kept

        with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
            yield
        # Read now, and only of living tensors: later tensors may reuse the addresses of freed ones.
        saved = _storages(tensor for noted in packed if (tensor := noted()) is not None)
        held = _storages(tensors_in(self.holders))
        self._noted = kind, sum(size for address, size in saved.items() if address not in held)

    def state_dict(self) -> State:
        """Return the peak so far, and the measured kinds of steps."""
        return {"largest_bytes": self.largest_bytes, "counted": sorted(self._counted)}

    def load_state_dict(self, state: State) -> None:
        """Continue a run of the same config and data."""
        self.largest_bytes = int(state["largest_bytes"])
        self._counted = set(state["counted"])

    def record(self, render: Render) -> None:
        """Add up the memory of a step whose forward pass was measured.

        Call it while the step's gradients exist. Steps without a backward pass need no call: others
        of their kind use more memory.
        """
        if self.device == "cuda":
            self.largest_bytes = max(self.largest_bytes, torch.cuda.max_memory_allocated())
        if self._noted is not None:
            kind, saved_bytes = self._noted
            held = sum(_storages(tensors_in(self.holders)).values())
            self.largest_bytes = max(self.largest_bytes, held + saved_bytes + render.buffer_bytes)
            self._counted.add(kind)
            self._noted = None


def tensors_in(value: object) -> Iterator[Tensor]:
    """Yield all tensors in an object, its items and attributes, and their gradients."""
    seen: set[int] = set()
    waiting: list[Any] = [value]
    while waiting:
        inner = waiting.pop()
        if id(inner) in seen:
            continue
        seen.add(id(inner))
        if isinstance(inner, Tensor):
            yield inner
            if inner.is_leaf and inner.grad is not None:
                yield inner.grad
        elif isinstance(inner, Mapping):
            # Iterating over the items of `OnDemand` would make the values that are not cached.
            waiting += [inner.kept, inner.make] if isinstance(inner, OnDemand) else inner.values()
        elif isinstance(inner, (list, tuple, set, frozenset)):
            waiting += inner
        elif hasattr(inner, "__dict__") and not isinstance(inner, _CODE):
            waiting += vars(inner).values()


def _storages(tensors: Iterable[Tensor]) -> dict[int, int]:
    """Return memory address -> size in bytes, of the tensors' storages."""
    found = (tensor.untyped_storage() for tensor in tensors)
    return {storage.data_ptr(): storage.nbytes() for storage in found}
