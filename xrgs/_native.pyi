"""The compiled kernels (`xrgs/native`): what each family's bind.cpp defines."""

from collections.abc import Sequence

from torch import Tensor

def isa() -> str: ...
def set_isa(name: str) -> None: ...
def available_isas() -> list[str]: ...
def exp2(x: Tensor) -> Tensor: ...
def log2(x: Tensor) -> Tensor: ...
def photometric(
    image: Tensor,
    target: Tensor,
    mean: Tensor,
    variance: Tensor,
    l1: float,
    ssim: float,
    with_gradient: bool,
    threads: int,
) -> tuple[float, Tensor | None]: ...
def adam(
    groups: list[tuple[Tensor, Tensor, Tensor, Tensor, float, float]],
    beta1: float,
    beta2: float,
    eps: float,
    threads: int,
) -> None: ...
def observe(
    slope: Tensor,
    visible: Tensor,
    scale_x: float,
    scale_y: float,
    gradient: Tensor,
    seen: Tensor,
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
def adam_harmonics(
    parameter: Tensor,
    mean: Tensor,
    square: Tensor,
    means: Tensor,
    sh0_gradient: Tensor,
    position: Sequence[float],
    degree: int,
    lr: float,
    step: float,
    beta1: float,
    beta2: float,
    eps: float,
    threads: int,
) -> None: ...
def multiply_adds_per_second(threads: int) -> float: ...

class View:
    @staticmethod
    def make(
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
        skips: Sequence[bool],
    ) -> View: ...

class Frame:
    def __init__(self) -> None: ...
    # The six parameters, the offsets or None, and the number of threads.
    def forward(self, view: View, *inputs: Tensor | int | None) -> tuple[Tensor, Tensor]: ...
    # The gradients of image and alpha, and then the same, with shN's gradient or without before the
    # number of threads.
    def backward(self, *inputs: Tensor | int | None) -> tuple[Tensor | None, ...]: ...
    def visible(self) -> Tensor: ...
    @property
    def pairs(self) -> int: ...
    @property
    def evaluations(self) -> int: ...
    @property
    def bytes(self) -> int: ...
    @property
    def timings(self) -> dict[str, float]: ...
