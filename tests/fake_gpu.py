"""A device that a GPU's rules hold on, with the processor's arithmetic: `with fake_gpu():`.

Tensors on `DEVICE` are not the processor's: as with CUDA, an operation on tensors of both fails
unless the processor's has no dimension, numpy takes none of them, and a generator of the processor
draws none. So a training on it shows where code takes tensors for the processor's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves, tree_map

#: A type of device that has no kernels here; autograd runs its backward passes on our thread.
DEVICE = torch.device("lazy", 0)


class _OnGpu(torch.Tensor):
    """A tensor that says it is on `DEVICE`; `of_processor` has its values."""

    of_processor: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> _OnGpu:
        made: _OnGpu = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.shape,
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=DEVICE,
        )
        made.of_processor = inner
        return made

    def data_ptr(self) -> int:
        return self.of_processor.data_ptr()

    def untyped_storage(self) -> torch.UntypedStorage:
        return self.of_processor.untyped_storage()

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, operation: Any, _types: object, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _run(operation, args, kwargs or {})


def _run(operation: Any, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
    """Check the devices of an operation, and do it on the processor."""
    given = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    ours = [tensor for tensor in given if isinstance(tensor, _OnGpu)]
    others = [tensor for tensor in given if not isinstance(tensor, _OnGpu) and tensor.ndim]
    name = operation.overloadpacket.__name__
    if ours and others and name != "copy_":
        shapes = [list(tensor.shape) for tensor in given]
        raise RuntimeError(f"{operation}: tensors on {DEVICE} and on the processor: {shapes}")
    kwargs = dict(kwargs)
    on_gpu = bool(ours)
    if kwargs.get("device") is not None:
        on_gpu = torch.device(kwargs["device"]).type == DEVICE.type
        kwargs["device"] = torch.device("cpu")
    if on_gpu and kwargs.get("generator") is not None:
        raise RuntimeError(f"{operation}: a generator of the processor on {DEVICE}")
    inner_args, inner_kwargs = tree_map(_inner, (tuple(args), kwargs))
    with _disable_current_modes():
        made = operation(*inner_args, **inner_kwargs)
    known = {id(tensor.of_processor): tensor for tensor in ours}

    def outer(value: Any) -> Any:
        if not isinstance(value, torch.Tensor):
            return value
        if id(value) in known:  # changed in place
            return known[id(value)]
        return _OnGpu(value) if on_gpu else value

    return tree_map(outer, made)


def _inner(value: Any) -> Any:
    return value.of_processor if isinstance(value, _OnGpu) else value


class _Operations(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Sees operations without a tensor on the device, as `torch.zeros(3, device=DEVICE)`."""

    def __torch_dispatch__(
        self, operation: Any, _types: object, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _run(operation, args, kwargs or {})


class _Functions(TorchFunctionMode):
    """Does what torch does in C++ for its own devices only."""

    def __torch_function__(
        self, function: Callable[..., Any], _types: object, args: Any = (), kwargs: Any = None
    ) -> Any:
        kwargs = dict(kwargs or {})
        if function is torch.Tensor.tolist:
            return function(args[0].detach().cpu())
        if function is torch.Tensor.new_tensor:
            kwargs = {"dtype": args[0].dtype, "device": args[0].device} | kwargs
            function, args = torch.tensor, args[1:]
        if function in {torch.tensor, torch.as_tensor}:
            device = kwargs.pop("device", None) or torch.device("cpu")
            return function(*args, **kwargs).to(device)
        return function(*args, **kwargs)


@contextmanager
def fake_gpu() -> Iterator[None]:
    """Let torch compute on `DEVICE`."""
    with _Operations(), _Functions():  # type: ignore[no-untyped-call]
        yield
