"""gsplat's renderer: what it is asked for, and what becomes of its answer.

gsplat's kernels need a GPU. `gsplat_api.rasterization` stands in for them, and the truth is our
renderer without gsplat's signature in between.
"""

from __future__ import annotations

import importlib
import sys
import weakref
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.gsplat_stand_in import stand_in
from tests.splat.scenes import Scene, draw, gradients_of, make_camera, make_scene, with_gradients
from xrgs.errors import XrgsError
from xrgs.splat import backend
from xrgs.splat.gaussians import PARAMETERS, ActivatedGaussians
from xrgs.splat.rendering import Render, attribute_pixels, zero_means2d_offset
from xrgs.splat.settings import RasterSettings

pytest.importorskip("xrgs._native", reason="the kernels were not built")

#: With the constants of gsplat 1.5.3's kernels.
SETTINGS = RasterSettings(alpha_max=0.999)
CAMERA = make_camera(40, 28, focal=36.0, turned=True)
SCENE = make_scene(60, CAMERA, dtype=torch.float32)
MODULE = "xrgs.splat.gsplat.rasterizer"


@pytest.fixture(autouse=True)
def _stand_in() -> Iterator[None]:
    with stand_in():
        yield


def differentiated(of_backend: str, scene: Scene = SCENE, **options: Any) -> tuple[Render, Scene]:
    """A render, and the gradients of a loss of it by each parameter and the offset."""
    leaves = with_gradients(scene)
    offset = zero_means2d_offset(len(leaves["means"]))
    arguments: dict[str, Any] = {"camera": CAMERA, "raster": SETTINGS} | options
    render = draw(leaves, **arguments, means2d_offset=offset, backend=of_backend)
    weights = torch.rand(*render.image.shape[:2], 4, generator=torch.Generator().manual_seed(1))
    loss = (render.image * (weights[..., :3] - 0.3)).sum() + (render.alpha * weights[..., 3]).sum()
    torch.autograd.backward(loss)
    return render, gradients_of({**leaves, "offset": offset})


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"sh_degree": 0},
        {"sh_degree": 1, "raw": True},
        {"raster": replace(SETTINGS, antialiased=True, eps2d=0.1, background=(0.2, 0.7, 1.0))},
        {"raster": replace(SETTINGS, absgrad=True, near=3.0)},
        {"camera": CAMERA.resized(30, 50)},
    ],
)
def test_render_and_gradients_are_those_of_our_renderer(options: dict[str, Any]) -> None:
    scene = SCENE
    if options.get("raw"):
        raw = {"scales": scene["scales"].log(), "opacities": scene["opacities"].logit()}
        scene = {**scene, **raw}
    theirs, their_gradients = differentiated("gsplat", scene, **options)
    ours, our_gradients = differentiated("native", scene, **options)
    torch.testing.assert_close(theirs.image, ours.image, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(theirs.alpha, ours.alpha, rtol=1e-5, atol=1e-6)
    for name, gradient in our_gradients.items():
        assert gradient.any() or (name == "shN" and options.get("sh_degree") == 0), name
        scale = gradient.abs().max().item()
        torch.testing.assert_close(their_gradients[name], gradient, rtol=1e-4, atol=1e-5 * scale)
    # gsplat rounds radii up: what is just outside the image counts as visible, without a gradient.
    assert ours.visible.any()
    assert not (ours.visible & ~theirs.visible).any()
    assert not their_gradients["offset"][theirs.visible & ~ours.visible].any()


def test_pixels_are_attributed_as_by_our_renderer() -> None:
    pixels = torch.rand(28, 40, generator=torch.Generator().manual_seed(2))
    gaussians = ActivatedGaussians(*(SCENE[name] for name in PARAMETERS))
    theirs, ours = (
        attribute_pixels(pixels, gaussians, CAMERA, SETTINGS, backend=name).sums
        for name in ("gsplat", "native")
    )
    assert ours.any()
    torch.testing.assert_close(theirs, ours, rtol=1e-4, atol=1e-5)


class AbsgradOf153(torch.autograd.Function):
    """Stores `absgrad` in the backward pass, as `_RasterizeToPixels` of gsplat 1.5.3."""

    @staticmethod
    def forward(ctx: Any, means2d: Tensor) -> Tensor:
        ctx.save_for_backward(means2d)
        return means2d.square().sum(dim=(0, 2))

    @staticmethod
    def backward(ctx: Any, v_sums: Tensor) -> Tensor:
        (means2d,) = ctx.saved_tensors
        means2d.absgrad = (2 * means2d * v_sums[:, None]).abs()
        gradient: Tensor = 2 * means2d * v_sums[:, None]
        return gradient


def fill(holder: Tensor, gradient: Tensor) -> None:
    holder.copy_(gradient.abs())


@pytest.mark.parametrize("version", ["1.5.3", "1.6"])
@pytest.mark.parametrize("absgrad", [False, True])
def test_means2d_in_the_graph_give_the_offset_its_gradient_and_are_freed(
    version: str, absgrad: bool
) -> None:
    """gsplat's `means2d` is no leaf, as the stand-in's is, and has `absgrad` in two ways."""
    made: list[weakref.ref[Tensor]] = []

    def like_gsplat(**given: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        means2d = -given["means"][None, :, :2].tanh()  # [1, N, 2]
        made.append(weakref.ref(means2d))
        if version == "1.6" and given["absgrad"]:
            holder = torch.zeros_like(means2d)
            means2d.register_hook(partial(fill, holder))
            means2d.absgrad = holder
            sums = means2d.square().sum(dim=(0, 2))
        else:
            sums = AbsgradOf153.apply(means2d)  # type: ignore[no-untyped-call]
        image = sums.sum().expand(1, 28, 40, 3)
        meta = {"means2d": means2d, "radii": torch.ones(1, 60, 2), "tile_size": 16}
        return image, image[..., :1], meta | {"flatten_ids": torch.zeros(7)}

    with stand_in(function=like_gsplat):
        settings = replace(SETTINGS, absgrad=absgrad)
        for with_backward in (True, False):
            leaves, offset = with_gradients(SCENE), zero_means2d_offset(60)
            render = draw(leaves, CAMERA, settings, means2d_offset=offset, backend="gsplat")
            assert render.evaluations == 7 * 16**2
            if with_backward:
                torch.autograd.backward(render.image[0, 0, 0])
                expected = -2 * SCENE["means"][:, :2].tanh()
                torch.testing.assert_close(offset.grad, expected.abs() if absgrad else expected)
            # Without the garbage collector, which knows nothing of a graph's memory on a GPU.
            del render, offset
            assert made[-1]() is None


def test_an_offset_that_gsplat_would_not_add_is_refused() -> None:
    with pytest.raises(ValueError, match="means2d_offset must be of zero_means2d_offset"):
        draw(SCENE, CAMERA, SETTINGS, means2d_offset=torch.zeros(60, 2), backend="gsplat")


@pytest.mark.parametrize(
    ("name", "value", "constant"),
    [("alpha_min", 0.01, "0.0039"), ("transmittance_min", 0, "0.0001")],
)
def test_constants_of_gsplats_kernels_are_named(name: str, value: float, constant: str) -> None:
    changed: dict[str, Any] = {name: value}
    expected = rf"splat\.raster\.{name}={value}: .* gsplat 1\.5\.3 have {constant}"
    with pytest.raises(XrgsError, match=expected):
        draw(SCENE, CAMERA, replace(SETTINGS, **changed), backend="gsplat")


def fails_to_load() -> str:
    """The message of a renderer that can't be loaded."""
    sys.modules.pop(MODULE, None)
    with pytest.raises(XrgsError) as failure:
        importlib.import_module(MODULE)
    return str(failure.value)


def test_a_machine_without_a_gpu_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(backend.DEVICES, "gsplat", "cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", None)
    assert "built for the CPU only, sees no CUDA GPU" in fails_to_load()
    monkeypatch.setattr(torch.version, "cuda", "12.4")
    assert "built for CUDA 12.4, sees no CUDA GPU" in fails_to_load()


def test_kernels_that_cannot_be_compiled_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    # What gsplat does where it finds no nvcc, and where nvcc or ninja fails.
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", SimpleNamespace(_C=None))
    assert "no CUDA compiler" in fails_to_load()

    class Failing(ModuleType):
        def __getattr__(self, name: str) -> object:
            raise RuntimeError("Error building extension 'gsplat_cuda'\nlong output")

    monkeypatch.setitem(sys.modules, "gsplat.cuda", Failing("gsplat.cuda"))
    message = fails_to_load()
    assert "can't be loaded (Error building extension 'gsplat_cuda');" in message
    assert "nvcc" in message
