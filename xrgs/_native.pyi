"""The types of the compiled kernels, which the bind.cpp files of `xrgs/csrc` define.

The docstrings are in the module (`help(xrgs._native)`). Tensors are float32, on the CPU and
contiguous.
"""

from collections.abc import Sequence
from typing import Any

from torch import Tensor

def isa() -> str: ...
def set_isa(name: str) -> None: ...
def available_isas() -> list[str]: ...
def fused_multiply_add() -> bool: ...
def exp2(x: Tensor) -> Tensor: ...
def log2(x: Tensor) -> Tensor: ...
def exp(x: Tensor, threads: int) -> Tensor: ...
def exp_backward(v_y: Tensor, y: Tensor, threads: int) -> Tensor: ...
def logistic(x: Tensor, threads: int) -> Tensor: ...
def logistic_backward(v_y: Tensor, y: Tensor, threads: int) -> Tensor: ...
def unused_bytes() -> int: ...
def sqrt_upper_bound(x: Tensor) -> Tensor: ...
def photometric_loss(
    image: Tensor,
    target: Tensor,
    target_mean: Tensor,
    target_variance: Tensor,
    pixel_weight: Tensor | None,
    l1: float,
    ssim: float,
    with_gradient: bool,
    threads: int,
) -> tuple[float, Tensor | None]: ...
def window_moments(image: Tensor, window: Tensor, threads: int) -> tuple[Tensor, Tensor]: ...
def adam_step(
    groups: list[tuple[Tensor, Tensor, Tensor, Tensor, float, float]],
    beta1: float,
    beta2: float,
    eps: float,
    threads: int,
    harmonics: tuple[Any, ...] | None = None,
) -> None: ...
def accumulate_grad2d(
    means2d_grad: Tensor,
    visible: Tensor,
    scale_x: float,
    scale_y: float,
    grad2d_sum: Tensor,
    visible_count: Tensor,
    threads: int,
) -> None: ...
def resample(
    image: Tensor,
    row_first: Tensor,
    row_weights: Tensor,
    column_first: Tensor,
    column_weights: Tensor,
    threads: int,
) -> Tensor: ...

class RenderConfig:
    def __init__(
        self,
        *,
        viewmat: Sequence[float],
        intrinsics: Sequence[float],
        width: int,
        height: int,
        near: float,
        eps2d: float,
        alpha_min: float,
        alpha_max: float,
        transmittance_min: float,
        antialiased: bool,
        absgrad: bool,
        background: Sequence[float],
        sh_degree: int,
        culling: Sequence[bool],
        raw: bool = False,
    ) -> None: ...

class Frame:
    def __init__(self) -> None: ...
    # The inputs are the six parameters, means2d_offset or None, and the number of threads.
    def forward(
        self, config: RenderConfig, *inputs: Tensor | int | None
    ) -> tuple[Tensor, Tensor]: ...
    # The inputs are the gradients of image and alpha, the six parameters, means2d_offset or None,
    # whether the gradient of shN is needed, and the number of threads. The last result is whether
    # all gradients are finite.
    def backward(self, *inputs: Tensor | int | None) -> tuple[*tuple[Tensor | None, ...], bool]: ...
    def visible(self) -> Tensor: ...
    @property
    def pair_count(self) -> int: ...
    @property
    def evaluations(self) -> int: ...
    @property
    def bytes(self) -> int: ...
    @property
    def timings(self) -> dict[str, float]: ...
