"""The memory of training: bounds what is kept of the photographs, and counts what is held."""

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
    """Tensors of training views by the views' names, made anew where they are not kept.

    The values of the first views are kept, as far as `KEPT_BYTES` go. Which views are first does
    not matter, since they are drawn in random order.

    Attributes:
        make: What makes a value; `TrainingMemory` counts its tensors too.
        kept: The values that are kept.
    """

    def __init__(self, make: Callable[[TrainingView], T], views: Iterable[TrainingView]) -> None:
        """Make the values that are kept.

        Args:
            make: Returns the value of a view: a tensor, or an object that has some.
            views: The views, with unique names.
        """
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
    """The largest number of bytes that a step of training held.

    A step holds the model, its gradients and the optimizer's state, the statistics of
    densification, the photographs (8 bits), the moments that are kept of them and the target of the
    step's view for the loss, the tensors of the components, what autograd saves between forward and
    backward, and the buffers of the renderer. All count as if they existed at once; tensors that
    share their memory count once. What forward and backward allocate and free in between does not
    count. On a GPU the count is the most that torch has allocated there, all of this included.

    Steps with the same number of Gaussians and harmonics, on views of one size and class whose
    moments are all kept or all not, hold the same. Only the first of them is counted.

    Attributes:
        largest_bytes: The largest count so far.
    """

    def __init__(self, *holders: object, device: str = "cpu") -> None:
        """Start with nothing counted.

        Args:
            holders: Objects that hold tensors throughout training, in their attributes or items.
            device: Where training has its tensors: `cpu` or `cuda`.
        """
        self.holders = holders
        self.device = device
        if device == "cuda":
            torch.cuda.reset_peak_memory_stats()
        self.largest_bytes = 0
        self._counted: set[str] = set()
        self._noted: tuple[str, int] | None = None
        """The kind of a step whose forward pass was noted, and the bytes that autograd saved."""

    @contextmanager
    def of_forward(
        self, step: Step, gaussians: int, sh_degree: int, *, kept: bool = True
    ) -> Iterator[None]:
        """Note what autograd saves in the forward pass of a step that has not been counted.

        Args:
            step: The step.
            gaussians: The number of Gaussians.
            sh_degree: Highest band of the spherical harmonics that is rendered.
            kept: Whether the moments of the view's photograph are kept.
        """
        camera, logged = step.view.camera, sorted(step.log.items())
        size = f"{camera.width} x {camera.height} px"
        kind = f"{gaussians} {sh_degree} {step.view.tag} {size} {kept} {logged}"
        self._noted = None
        # On a GPU without hooks: with them, gsplat 1.5.3 loses the gradients of its `absgrad`.
        if kind in self._counted or self.device == "cuda":
            yield
            return
        packed: list[weakref.ref[Tensor]] = []

        def note(tensor: Tensor) -> Tensor:
            kept = tensor.detach()  # the tensor itself would make a cycle of references
            packed.append(weakref.ref(kept))
            return kept

        with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
            yield
        # Only what still exists, and now: other tensors will have the addresses of dropped ones.
        saved = _storages(tensor for noted in packed if (tensor := noted()) is not None)
        held = _storages(tensors_in(self.holders))
        self._noted = kind, sum(size for address, size in saved.items() if address not in held)

    def state_dict(self) -> State:
        """Return the largest count so far, and the kinds of steps that have been counted."""
        return {"largest_bytes": self.largest_bytes, "counted": sorted(self._counted)}

    def load_state_dict(self, state: State) -> None:
        """Continue a run of the same config and data."""
        self.largest_bytes = int(state["largest_bytes"])
        self._counted = set(state["counted"])

    def record(self, render: Render) -> None:
        """Count the step of a render, if its forward pass was noted, while its gradients exist.

        A step without a backward pass is not counted: another of its kind holds more.
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
            # Other values of `OnDemand` do not exist; to go through its items would make them.
            waiting += [inner.kept, inner.make] if isinstance(inner, OnDemand) else inner.values()
        elif isinstance(inner, (list, tuple, set, frozenset)):
            waiting += inner
        elif hasattr(inner, "__dict__") and not isinstance(inner, _CODE):
            waiting += vars(inner).values()


def _storages(tensors: Iterable[Tensor]) -> dict[int, int]:
    """Return the bytes of the memory of tensors by its address."""
    found = (tensor.untyped_storage() for tensor in tensors)
    return {storage.data_ptr(): storage.nbytes() for storage in found}
