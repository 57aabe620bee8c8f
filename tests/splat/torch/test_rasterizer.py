"""The reference rasterizer: tiles and batches change nothing, and work and memory are counted."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.splat.scenes import (
    draw,
    gradients_of,
    make_camera,
    make_scene,
    single_pixel,
    with_gradients,
)
from xrgs.splat.cameras import Camera
from xrgs.splat.settings import RasterSettings
from xrgs.splat.torch import rasterizer as torch_rasterizer
from xrgs.splat.torch import tiles


def test_tiles_and_batches_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = make_camera(33, 21)
    scene = make_scene(80, camera, seed=9, size=3.0)
    renders = []
    for tile, elements in ((8, 1 << 18), (4, 1 << 18), (16, 1 << 18), (64, 1 << 18), (8, 1)):
        monkeypatch.setattr(torch_rasterizer, "TILE", tile)
        monkeypatch.setattr(torch_rasterizer, "BATCH_ELEMENTS", elements)
        leaves = with_gradients(scene)
        render = draw(leaves, camera)
        torch.autograd.backward(render.image.square().sum())
        renders.append((render.image, *gradients_of(leaves).values()))
    for other in renders[1:]:
        for ours, theirs in zip(renders[0], other, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-11, atol=1e-11)


def test_too_many_pairs_is_an_error_before_they_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiles, "MAX_PAIRS", 10)
    camera = make_camera()
    with pytest.raises(MemoryError, match=r"pairs in one view, more than 10"):
        draw(make_scene(40, camera), camera)


# --- work and memory -----------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "absgrad"), [(torch.float32, False), (torch.float64, True)])
def test_bytes_of_a_batch_are_what_autograd_keeps(dtype: torch.dtype, absgrad: bool) -> None:
    entries = torch.rand(3, 50, 11 if absgrad else 9, dtype=dtype).requires_grad_()
    corner = torch.zeros(3, 2, dtype=dtype)
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if tensor.numel() >= 3 * 50 * 64:
            kept[storage.data_ptr()] = tensor.numel() * tensor.element_size()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        torch_rasterizer.composite(entries, corner, 8, RasterSettings(absgrad=absgrad))
    per_alpha = torch_rasterizer.alpha_bytes(dtype.itemsize, absgrad=absgrad)
    assert sum(kept.values()) == 3 * 50 * 64 * per_alpha


def test_evaluations_and_bytes_are_those_of_the_lists(pixel: Camera) -> None:
    few, many = (draw(single_pixel(count, opacity=0.01), pixel, sh_degree=0) for count in (10, 400))
    assert few.evaluations == 10 * torch_rasterizer.TILE**2
    assert few.buffer_bytes > 10 * torch_rasterizer.TILE**2 * torch_rasterizer.alpha_bytes(4)
    assert many.buffer_bytes > 20 * few.buffer_bytes
