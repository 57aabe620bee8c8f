"""Counts the memory that training holds: every tensor once, and the renderer's buffers."""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from xrgs.splat.rendering import Render
    from xrgs.training.checkpoint import State
    from xrgs.training.components import Step


_CODE = (type, ModuleType, FunctionType)


class TrainingMemory:
    """The largest number of bytes that a step of training held.

    A step holds the model, its gradients and the optimizer's state, the statistics of
    densification, the photographs and their targets for the loss, the tensors of the components,
    what autograd saves between forward and backward, and the buffers of the renderer. All count as
    if they existed at once; tensors that share their memory count once. What backward allocates and
    frees in between does not count.

    Steps with the same number of Gaussians and harmonics, on views of one size and class, hold the
    same. Only the first of them is counted.

    Attributes:
        largest_bytes: The largest count so far.
    """

    def __init__(self, *holders: object) -> None:
        """Start with nothing counted.

        Args:
            holders: Objects that hold tensors throughout training, in their attributes or items.
        """
        self.holders = holders
        self.largest_bytes = 0
        self._counted: set[str] = set()
        self._noted: tuple[str, int] | None = None
        """The kind of a step whose forward pass was noted, and the bytes that autograd saved."""

    @contextmanager
    def of_forward(self, step: Step, gaussians: int, sh_degree: int) -> Iterator[None]:
        """Note what autograd saves in the forward pass of a step that has not been counted.

        Args:
            step: The step.
            gaussians: The number of Gaussians.
            sh_degree: Highest band of the spherical harmonics that is rendered.
        """
        size, logged = list(step.view.image.shape), sorted(step.log.items())
        kind = f"{gaussians} {sh_degree} {step.view.tag} {size} {logged}"
        self._noted = None
        if kind in self._counted:
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
            waiting += inner.values()
        elif isinstance(inner, (list, tuple, set, frozenset)):
            waiting += inner
        elif hasattr(inner, "__dict__") and not isinstance(inner, _CODE):
            waiting += vars(inner).values()


def _storages(tensors: Iterable[Tensor]) -> dict[int, int]:
    """Return the bytes of the memory of tensors by its address."""
    storages = (tensor.untyped_storage() for tensor in tensors)
    return {storage.data_ptr(): storage.nbytes() for storage in storages}
