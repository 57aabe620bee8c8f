"""The equations of docs/rasterizer.md agree with autograd through the torch rasterizer in float64.

The kernels are tested against the torch rasterizer elsewhere; these tests keep the page right. The
names are those of the page, and comments give the numbers of its equations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor
from torch.linalg import cross

from tests.splat.scenes import draw, gradients_of, make_camera, make_scene, with_gradients
from xrgs.splat.cameras import Camera
from xrgs.splat.settings import RasterSettings
from xrgs.splat.sh import sh_basis

N = 14


def dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


def random(*shape: int, generator: torch.Generator) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def scene_of(camera: Camera) -> dict[str, Tensor]:
    """Gaussians in and around the image; some are so far outside that slopes are clamped."""
    made = make_scene(N, camera, seed=1, size=3.0)
    outward = made["means"] - made["means"].mean(0)
    made["means"][::3] += outward[::3]
    return made


@dataclass
class Forward:
    """Equations 1 to 10 for every Gaussian."""

    scene: dict[str, Tensor]
    camera: Camera
    raster: RasterSettings

    def __post_init__(self) -> None:
        s, self.W, K = self.scene, self.camera.viewmat[:3, :3], self.camera.K
        self.fx, self.fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        local = s["means"] @ self.W.T + self.camera.viewmat[:3, 3]
        self.x, self.y, self.z = local.unbind(-1)  # 1
        self.mean2d = torch.stack(
            [self.fx * self.x / self.z + cx, self.fy * self.y / self.z + cy], dim=-1
        )  # 2
        self.sx, self.sx_free = self._clamped(self.x / self.z, cx, self.fx, self.camera.width)
        self.sy, self.sy_free = self._clamped(self.y / self.z, cy, self.fy, self.camera.height)
        self.q = s["quats"] / s["quats"].norm(dim=-1, keepdim=True)
        self.Q = self._rotation()
        self.a = self.W @ (self.Q * s["scales"][:, None, :])
        # 4
        self.m0 = (self.fx / self.z)[:, None] * (self.a[:, 0] - self.sx[:, None] * self.a[:, 2])
        self.m1 = (self.fy / self.z)[:, None] * (self.a[:, 1] - self.sy[:, None] * self.a[:, 2])
        self.n = cross(self.m0, self.m1)
        eps = self.raster.eps2d
        xx, yy = dot(self.m0, self.m0), dot(self.m1, self.m1)
        self.xx, self.xy, self.yy = xx + eps, dot(self.m0, self.m1), yy + eps  # 5
        self.D = dot(self.n, self.n) + eps * (xx + yy) + eps * eps  # 6
        self.lxx = (self.yy / (2 * self.D)).sqrt()  # 7
        self.lxy = self.lxx * self.xy / self.yy
        self.lyy = 1 / (2 * self.yy).sqrt()
        offset = s["means"] - self.camera.position
        self.distance = offset.norm(dim=-1, keepdim=True)
        self.r = offset / self.distance
        self.Y = sh_basis(3, self.r)
        self.coefficients = torch.cat([s["sh0"], s["shN"]], dim=1)
        self.unclamped = 0.5 + torch.einsum("nk,nkc->nc", self.Y, self.coefficients)  # 9
        self.c = self.unclamped.clamp_min(0)
        self.n_length = self.n.norm(dim=-1)
        self.compensation = self.n_length / self.D.sqrt()
        self.o = s["opacities"] * (self.compensation if self.raster.antialiased else 1)  # 10

    @staticmethod
    def _clamped(slope: Tensor, centre: Tensor, focal: Tensor, size: int) -> tuple[Tensor, Tensor]:
        margin = 0.3 * 0.5 * size / focal  # 3
        low, high = -centre / focal - margin, (size - centre) / focal + margin
        return slope.clamp(low, high), (low <= slope) & (slope <= high)

    def _rotation(self) -> Tensor:
        w, x, y, z = self.q.unbind(-1)
        rows = [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ]
        return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


@dataclass
class PairGrads:
    """Equations 8 and 14 to 18 and 21: one pixel after another, summed over all pixels."""

    f: Forward

    def __post_init__(self) -> None:
        size = self.f.camera.height, self.f.camera.width
        self.background = torch.tensor(self.f.raster.background, dtype=torch.float64)
        self.image = torch.zeros(*size, 3, dtype=torch.float64)
        self.alpha = torch.zeros(*size, dtype=torch.float64)
        self.sums = torch.zeros(N, 6, dtype=torch.float64)
        self.v_color = torch.zeros(N, 3, dtype=torch.float64)
        self.absgrad = torch.zeros(N, 2, dtype=torch.float64)

    def add_pixel(self, row: int, column: int, v_image: Tensor, v_alpha: Tensor) -> None:
        f, raster = self.f, self.f.raster
        dx, dy = column + 0.5 - f.mean2d[:, 0], row + 0.5 - f.mean2d[:, 1]
        u, v = f.lxx * dx - f.lxy * dy, f.lyy * dy
        raw = f.o * torch.exp(-u * u - v * v)
        alpha = torch.where(raw < raster.alpha_min, 0.0, raw.clamp_max(raster.alpha_max))  # 8
        T, composited = torch.ones((), dtype=torch.float64), []
        for i in torch.argsort(f.z).tolist():
            if T * (1 - alpha[i]) <= raster.transmittance_min:
                break
            composited.append((i, alpha[i] * T))
            self.image[row, column] += alpha[i] * T * f.c[i]
            T = T * (1 - alpha[i])  # 14
        self.image[row, column] += T * self.background  # 15
        self.alpha[row, column] = 1 - T
        R = torch.zeros((), dtype=torch.float64)
        for i, weight in reversed(composited):
            G = f.c[i] @ v_image - self.background @ v_image + v_alpha  # 16
            g = weight * (G - R) * (raw[i] <= raster.alpha_max)  # 17
            R = R + alpha[i] * (G - R)
            of_u, y = u[i], dy[i]
            powers = [torch.ones_like(y), of_u, y, of_u * of_u, of_u * y, y * y]
            self.sums[i] += g * torch.stack(powers)  # 18
            self.v_color[i] += weight * v_image
            by_y = f.lyy[i] * v[i] - f.lxy[i] * u[i]
            self.absgrad[i] += torch.stack([2 * g * f.lxx[i] * u[i], 2 * g * by_y]).abs()  # 21


def gradients(f: Forward, pairs: PairGrads) -> dict[str, Tensor]:
    """Equations 19 to 32."""
    S1, Su, Sy, Suu, Suy, Syy = pairs.sums.unbind(-1)
    v_o = S1 / f.o  # 19
    v_mean2d = torch.stack([2 * f.lxx * Su, 2 * (f.lyy**2 * Sy - f.lxy * Su)], dim=-1)  # 20
    shared, v_lxy, v_lyy = -2 * Suu, 2 * Suy, -2 * f.lyy * Syy  # 22
    v_xy = f.lxx / f.yy * v_lxy  # 23
    v_yy = (shared / 2 - f.lyy * v_lyy / 2 - f.lxy * v_lxy) / f.yy
    v_D = -shared / (2 * f.D)
    v_n_length, v_opacity = torch.zeros_like(v_D), v_o
    if f.raster.antialiased:  # 24
        v_D = v_D - v_o * f.o / (2 * f.D)
        v_n_length = v_o * f.scene["opacities"] / f.D.sqrt()
        v_opacity = v_o * f.compensation
    v_n = (2 * v_D + v_n_length / f.n_length)[:, None] * f.n
    eps = f.raster.eps2d
    v_m0 = cross(f.m1, v_n) + 2 * (eps * v_D)[:, None] * f.m0 + v_xy[:, None] * f.m1  # 25
    v_m1 = cross(v_n, f.m0) + 2 * (v_yy + eps * v_D)[:, None] * f.m1 + v_xy[:, None] * f.m0
    v_mean, v_scale, v_quat = geometry_gradients(f, v_mean2d, v_m0, v_m1)
    v_unclamped = torch.where(f.unclamped >= 0, pairs.v_color, 0.0)
    v_coefficients = f.Y[:, :, None] * v_unclamped[:, None, :]  # 31
    direction = f.r.clone().requires_grad_()
    colors = torch.einsum("nk,nkc->nc", sh_basis(3, direction), f.coefficients)
    (v_r,) = torch.autograd.grad((v_unclamped * colors).sum(), direction)
    v_mean = v_mean + (v_r - dot(v_r, f.r)[:, None] * f.r) / f.distance  # 32
    return {
        "means": v_mean,
        "quats": v_quat,
        "scales": v_scale,
        "opacities": v_opacity,
        "sh0": v_coefficients[:, :1],
        "shN": v_coefficients[:, 1:],
        "means2d_offset": v_mean2d,
    }


def geometry_gradients(
    f: Forward, v_mean2d: Tensor, v_m0: Tensor, v_m1: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Equations 26 to 30: means (without their colour's part), scales, quaternions."""
    v_a0, v_a1 = (f.fx / f.z)[:, None] * v_m0, (f.fy / f.z)[:, None] * v_m1  # 26
    v_a = torch.stack([v_a0, v_a1, -f.sx[:, None] * v_a0 - f.sy[:, None] * v_a1], dim=1)
    v_sx = torch.where(f.sx_free, -dot(v_a0, f.a[:, 2]), 0.0)
    v_sy = torch.where(f.sy_free, -dot(v_a1, f.a[:, 2]), 0.0)
    v_x = (f.fx * v_mean2d[:, 0] + v_sx) / f.z  # 27
    v_y = (f.fy * v_mean2d[:, 1] + v_sy) / f.z
    v_z = -(f.x * v_x + f.y * v_y + dot(v_m0, f.m0) + dot(v_m1, f.m1)) / f.z
    v_mean = torch.stack([v_x, v_y, v_z], dim=-1) @ f.W  # 28
    v_B = f.W.T @ v_a
    v_scale = (v_B * f.Q).sum(1)  # 29
    V = v_B * f.scene["scales"][:, None, :]
    w, x, y, z = f.q.unbind(-1)
    V00, V01, V02, V10, V11, V12, V20, V21, V22 = V.flatten(1).unbind(-1)
    rows = [  # 30
        x * (V21 - V12) + y * (V02 - V20) + z * (V10 - V01),
        y * (V10 + V01) + z * (V02 + V20) - 2 * x * (V11 + V22) + w * (V21 - V12),
        x * (V10 + V01) + z * (V21 + V12) - 2 * y * (V00 + V22) + w * (V02 - V20),
        x * (V02 + V20) + y * (V21 + V12) - 2 * z * (V00 + V11) + w * (V10 - V01),
    ]
    v_unit = 2 * torch.stack(rows, dim=-1)
    length = f.scene["quats"].norm(dim=-1, keepdim=True)
    return v_mean, v_scale, (v_unit - dot(v_unit, f.q)[:, None] * f.q) / length


@pytest.mark.slow
@pytest.mark.parametrize(
    ("width", "height", "raster"),
    [
        (14, 10, RasterSettings(background=(0.2, 0.5, 0.9))),
        (14, 10, RasterSettings(antialiased=True, eps2d=0.1)),
        (17, 8, RasterSettings(alpha_min=0.1, alpha_max=0.5, transmittance_min=0.2)),
        (9, 16, RasterSettings(alpha_min=0.0, alpha_max=1.0, transmittance_min=0.0)),
        (1, 9, RasterSettings()),
    ],
)
def test_the_equations_are_those_of_the_torch_rasterizer(
    width: int, height: int, raster: RasterSettings
) -> None:
    camera = make_camera(width, height, focal=13.0, turned=True)
    scene, g = scene_of(camera), torch.Generator().manual_seed(2)
    v_image, v_alpha = random(height, width, 3, generator=g), random(height, width, generator=g)
    expected: dict[str, Tensor] = {}
    for absgrad in (True, False):
        leaves = with_gradients(scene | {"means2d_offset": torch.zeros(N, 2).double()})
        offset = leaves["means2d_offset"]
        render = draw(leaves, camera, replace(raster, absgrad=absgrad), means2d_offset=offset)
        torch.autograd.backward((render.image * v_image).sum() + (render.alpha * v_alpha).sum())
        expected |= gradients_of(leaves)
        if absgrad:
            expected["absgrad"] = expected.pop("means2d_offset")

    f = Forward(scene, camera, raster)
    pairs = PairGrads(f)
    for row in range(height):
        for column in range(width):
            pairs.add_pixel(row, column, v_image[row, column], v_alpha[row, column])
    ours = gradients(f, pairs) | {"absgrad": pairs.absgrad}

    assert not bool(f.sx_free.all() & f.sy_free.all())  # Eq. 3 clamps some
    assert bool((f.unclamped < 0).any())  # and Eq. 9
    torch.testing.assert_close(pairs.image, render.image.detach(), rtol=0, atol=1e-12)
    torch.testing.assert_close(pairs.alpha, render.alpha.detach(), rtol=0, atol=1e-12)
    assert ours.keys() == expected.keys()
    for name, value in ours.items():
        assert (value - expected[name]).norm() <= 1e-12 * expected[name].norm(), name
