"""The arguments of `xrgs.rasterization`: gsplat's signature, and what is refused by name."""

from __future__ import annotations

import inspect
from typing import Any

import gsplat
import pytest
import torch

from xrgs.splat.gsplat_api import rasterization


def arguments(**changes: Any) -> dict[str, Any]:
    """Arguments of 80 Gaussians and two cameras, some of them changed."""
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (80, 3), "quats": (80, 4), "scales": (80, 3), "opacities": (80,)}
    tensors = {name: torch.rand(shape, generator=generator) for name, shape in shapes.items()} | {
        "colors": torch.rand(80, 3, generator=generator)
    }
    Ks = torch.tensor([[40.0, 0, 18], [0, 38, 15], [0, 0, 1]]).repeat(2, 1, 1)
    views = {"viewmats": torch.eye(4).repeat(2, 1, 1), "Ks": Ks, "width": 37, "height": 29}
    return {**tensors, **views, "backgrounds": torch.zeros(2, 3), **changes}


def test_the_signature_is_gsplats() -> None:
    ours = inspect.signature(rasterization).parameters
    theirs = inspect.signature(gsplat.rasterization).parameters
    assert list(ours) == [*theirs, "backend"]
    for name, parameter in theirs.items():
        if name != "rolling_shutter":
            assert ours[name].default == parameter.default, name


UNSERVED: dict[str, Any] = {
    "sparse_grad": True,
    "distributed": True,
    "camera_model": "fisheye",
    "covars": torch.eye(3).repeat(80, 1, 1),
    "with_ut": True,
    "with_eval3d": True,
    "radial_coeffs": torch.zeros(2, 6),
    "tangential_coeffs": torch.zeros(2, 2),
    "thin_prism_coeffs": torch.zeros(2, 4),
    "ftheta_coeffs": object(),
    "rolling_shutter": 1,
    "viewmats_rs": torch.eye(4),
}


@pytest.mark.parametrize("name", UNSERVED)
def test_what_is_not_served_is_refused_by_name(name: str) -> None:
    with pytest.raises(NotImplementedError, match=f"^{name}: "):
        rasterization(**arguments(**{name: UNSERVED[name]}))


def test_gradients_of_cameras_are_refused() -> None:
    for name in ("viewmats", "Ks"):
        wrong = arguments(**{name: arguments()[name].requires_grad_()})
        with pytest.raises(NotImplementedError, match=rf"^{name}: .*{name}\.detach"):
            rasterization(**wrong)
        with torch.no_grad():
            rasterization(**wrong)


def test_gsplats_global_shutter_is_its_default() -> None:
    shutter = inspect.signature(gsplat.rasterization).parameters["rolling_shutter"].default
    rasterization(**arguments(rolling_shutter=shutter))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"render_mode": "N"}, "render_mode must be one of RGB, D, ED, RGB"),
        ({"rasterize_mode": "x"}, "rasterize_mode must be one of classic, antialiased"),
        ({"colors": torch.zeros(7, 3)}, r"colors must be \[N, D\].*N = 80, C = 2, got \[7, 3\]"),
        ({"sh_degree": 1}, r"colors must be \[N, K, 3\].*at least 4"),
        ({"sh_degree": 4}, "sh_degree must be 0 to 3, or None, got 4"),
        ({"sh_degree": 3, "colors": torch.zeros(80, 15, 3)}, "at least 16"),
        ({"backgrounds": torch.zeros(3)}, r"backgrounds must be \[2, 3\], got \[3\]"),
        ({"means": torch.zeros(1, 80, 3)}, r"means must be \[1, 3\], got \[1, 80, 3\]"),
        ({"opacities": torch.zeros(80, 1)}, "opacities"),
        ({"Ks": torch.eye(3)[None]}, r"viewmats must be \[C, 4, 4\]"),
        ({"viewmats": 2 * torch.eye(4).repeat(2, 1, 1)}, "camera 0: viewmat must be a rotation"),
        (
            {"means": torch.full((80, 3), torch.nan)},
            "means has values that are not finite",
        ),
        ({"means": torch.zeros(80, 3, device="meta")}, "means is on meta: xrgs renders on the CPU"),
    ],
)
def test_wrong_values_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rasterization(**arguments(**changes))
