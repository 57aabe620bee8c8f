"""Random and mostly hostile scenes for the compiled rasterizer, forward and backward.

    python -m tests.splat.native.fuzz_rasterizer --seed 0 --count 10000

draws the scenes of the seeds 0 to 9999. Each must give an image and gradients that are finite and
in range, or an error that names what can't be rendered. One scene in 20 is compared with torch in
float64, unless float32 can't be near it; one without a hostile case must render, and its gradients
are compared as well. The command ends with the first scene that fails, or with what was refused.
"""

from __future__ import annotations

import argparse
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from random import Random

import torch
from torch import Tensor

from tests.splat.native import oracle
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS, ActivatedGaussians
from xrgs.splat.native import rasterizer
from xrgs.splat.quaternions import rotation_matrices
from xrgs.splat.rendering import Render
from xrgs.splat.settings import CullingOptions, RasterSettings

SIZES = (1, 2, 3, 15, 16, 17)
"""Of images: below, at and above the sides of a block and of a tile; of scenes likewise."""
FLOAT32_MAX = 3e38
REFUSAL = re.compile(
    r"(the gradient of (means|quats|scales|opacities|sh0|shN|means2d_offset) is not finite"
    r"|sh0 and shN overflow|scales: a Gaussian is larger than 1e18 px in the image)"
)
"""The errors that a scene of finite numbers may give."""


@dataclass
class Scene:
    """What is rendered, and the gradients of the loss by its image and alpha."""

    means: Tensor  # [N, 3] in camera coordinates until `place_in_world`
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    sh0: Tensor  # [N, 1, 3]
    shN: Tensor  # noqa: N815  # [N, K - 1, 3]
    viewmat: Tensor  # [4, 4]
    K: Tensor  # [3, 3]
    width: int
    height: int
    sh_degree: int
    v_image: Tensor  # [H, W, 3]
    v_alpha: Tensor  # [H, W]
    means2d_offset: Tensor | None = None  # [N, 2]
    settings: RasterSettings = field(default_factory=RasterSettings)
    culling: CullingOptions = field(default_factory=CullingOptions)
    needed: tuple[bool, ...] = (True,) * 7
    """Whether the gradient of each parameter, and of the offset, is asked for."""
    cases: list[str] = field(default_factory=list)
    """The hostile cases in it."""

    def tensors(self) -> dict[str, Tensor]:
        """The parameters, and the offset where there is one."""
        values = {name: getattr(self, name) for name in (*PARAMETERS, "means2d_offset")}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def camera(self) -> Camera:
        return Camera(self.viewmat, self.K, self.width, self.height)


class Draw:
    """The random numbers of one scene."""

    def __init__(self, seed: int) -> None:
        self.random = Random(seed)
        self.generator = torch.Generator().manual_seed(seed)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator)

    def uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator)

    def one_of(self, *values: float) -> float:
        return self.random.choice(values)

    def share(self) -> float:
        return self.random.random()

    def chance(self, probability: float) -> bool:
        return self.share() < probability


# --- hostile cases: each changes a plain scene --------------------------------------------------

Case = Callable[[Draw, Scene], None]


def change(name: str, function: Callable[[Draw, Tensor], Tensor]) -> Case:
    """Replaces a tensor by a function of it."""

    def case(draw: Draw, scene: Scene) -> None:
        setattr(scene, name, function(draw, getattr(scene, name)))

    return case


def change_depths(function: Callable[[Draw, Tensor], Tensor | float]) -> Case:
    """Replaces the depths of the means, in the tensor."""

    def case(draw: Draw, scene: Scene) -> None:
        scene.means[:, 2] = function(draw, scene.means[:, 2])

    return case


def fill(name: str, *values: float) -> Case:
    """Sets every value of a tensor to one of these numbers."""
    return change(name, lambda draw, value: torch.full_like(value, draw.one_of(*values)))


def multiply(names: str, *factors: float) -> Case:
    """Multiplies some tensors by one of these numbers."""

    def case(draw: Draw, scene: Scene) -> None:
        factor = draw.one_of(*factors)
        for name in names.split():
            setattr(scene, name, getattr(scene, name) * factor)

    return case


def spread(name: str, decades: float) -> Case:
    """Multiplies each row of a tensor by a random power of ten."""
    return change(
        name,
        lambda draw, value: value * 10 ** (draw.normal(len(value), 1) * decades).clamp(-37, 37),
    )


def setting(name: str, *values: float) -> Case:
    """Changes a setting to one of these numbers."""

    def case(draw: Draw, scene: Scene) -> None:
        setattr(scene.settings, name, draw.one_of(*values))  # the scene has settings of its own

    return case


def focal(*values: float) -> Case:
    """Sets both focal lengths to one of these numbers."""

    def case(draw: Draw, scene: Scene) -> None:
        scene.K[0, 0] = scene.K[1, 1] = draw.one_of(*values)

    return case


def scales_flat(draw: Draw, scene: Scene) -> None:
    scene.scales[:, draw.random.randrange(3)] = 0


def camera_far_away(draw: Draw, scene: Scene) -> None:
    scene.viewmat[:3, 3] *= draw.one_of(1e4, 1e15, 1e30)


def centre_far_away(draw: Draw, scene: Scene) -> None:
    for axis in (0, 1):
        scene.K[axis, 2] = draw.one_of(-1, 1) * 10 ** draw.random.uniform(1, 12)


def offsets_huge(draw: Draw, scene: Scene) -> None:
    scene.means2d_offset = draw.normal(len(scene.means), 2) * draw.one_of(1, 1e3, 1e20)


GROUPS: tuple[Mapping[str, Case], ...] = (
    {
        "means near the near plane": change_depths(
            lambda draw, z: 0.01 + (draw.uniform(len(z)) - 0.5) * 10 ** (-3 - 3 * draw.share())
        ),
        "means on the camera's plane": change_depths(
            lambda draw, _: draw.one_of(0.0, 1e-38, 1e-45, -1e-30, 0.01)
        ),
        "means behind": change_depths(lambda draw, z: z * torch.sign(draw.normal(len(z)))),
        "means huge": multiply("means", 1e10, 1e18, 1e19, 1e20, 1e30, 3e37),
        "means of all sizes": spread("means", 12),
        "means on the axis": change("means", lambda _, means: means * torch.tensor([0.0, 0, 1])),
        "means all the same": change("means", lambda _, means: means[:1].repeat(len(means), 1)),
    },
    {
        "scales zero": fill("scales", 0),
        "scales tiny": fill("scales", 1e-45, 1e-30, 1e-20, 1e-10),
        "scales huge": multiply("scales", 1e2, 1e4, 1e6, 1e10, 1e18, 1e30),
        "scales of all sizes": change(
            "scales", lambda draw, scales: 10 ** (draw.normal(*scales.shape) * 10).clamp(-38, 38)
        ),
        "scales flat": scales_flat,
        "scales of needles": change(
            "scales", lambda _, scales: scales * torch.tensor([1e5, 1e-5, 1e-5])
        ),
    },
    {
        "quats zero": fill("quats", 0),
        "quats huge": multiply("quats", 1e10, 1e19, 1e30, 5e37),
        "quats tiny": multiply("quats", 1e-10, 1e-18, 1e-20, 1e-30, 1e-40),
        "quats of all sizes": spread("quats", 15),
    },
    {
        "opacities all alike": fill("opacities", 0, 1, 1e-42),
        "opacities at the threshold": change(
            "opacities", lambda draw, o: (1 + (draw.uniform(len(o)) - 0.5) * 1e-6) / 255
        ),
        "opacities zero or one": change("opacities", lambda _, opacities: opacities.round()),
    },
    {"colours huge or zero": multiply("sh0 shN", 1e6, 1e15, 1e30, 1e38, 0)},
    {"camera far away": camera_far_away},
    {
        "focal length tiny": focal(1e-3, 1e-10, 1e-30),
        "focal length huge": focal(1e5, 1e10, 1e18, 1e30),
        "focal lengths of two sizes": change(
            "K", lambda _, K: K * torch.tensor([[1e4, 1, 1], [1, 1e-4, 1], [1, 1, 1]])
        ),
        "principal point far away": centre_far_away,
    },
    {"offsets huge": offsets_huge},
    {"eps2d": setting("eps2d", 0.0, 1e-10, 10.0, 1e6)},
    {"alpha_min": setting("alpha_min", 0.0, 1e-6, 0.5)},
    {"near": setting("near", 0.0, 1e-20, -1.0, 100.0)},
    {"alpha_max": setting("alpha_max", 0.5, 0.9999, 1.0)},
    {"transmittance_min": setting("transmittance_min", 0.0, 1e-10, 0.5)},
    {"image gradients huge or zero": multiply("v_image v_alpha", 1e10, 1e20, 1e30, 1e37, 0)},
)
"""At most one case of each group is in a scene."""
LOSSY = {
    "means on the camera's plane",
    "means huge",
    "means of all sizes",
    "scales huge",
    "scales of all sizes",
    "scales of needles",
    "quats tiny",  # zero is what is below the root of the smallest number, that of the type
    "quats of all sizes",
    "opacities at the threshold",
    "camera far away",
    "focal length huge",
    "focal lengths of two sizes",
    "principal point far away",
    "offsets huge",
}
"""Cases whose rounding to float32 moves more than a rounding of the image."""


# --- scenes -------------------------------------------------------------------------------------


def random_scene(seed: int) -> Scene:
    """Return the scene of a seed: one in five is plain, the others have hostile cases."""
    draw = Draw(seed)
    scene = _plain_scene(draw)
    hostility = draw.one_of(0.0, 0.1, 0.1, 0.3, 0.7)
    for group in GROUPS:
        if draw.chance(hostility):
            name = draw.random.choice(list(group))
            group[name](draw, scene)
            scene.cases.append(name)
    _place_in_world(scene)
    return scene


def _plain_scene(draw: Draw) -> Scene:
    random = draw.random
    count = random.choice([0, *SIZES, 31, 33, random.randrange(300)])
    height, width = (random.choice([*SIZES, random.randrange(1, 65)]) for _ in "HW")
    sh_degree = random.randrange(4)
    bands = max(random.choice([0, 3, 8, 15]), (sh_degree + 1) ** 2 - 1)
    means = draw.normal(count, 3)
    means[:, 2] = means[:, 2].abs() * 3 + 0.5
    focal = max(width, height) * random.uniform(0.5, 2.0)
    return Scene(
        means=means,
        quats=draw.normal(count, 4),
        scales=torch.exp(draw.normal(count, 3) * 0.7 - 2),
        opacities=draw.uniform(count),
        sh0=draw.normal(count, 1, 3) * 0.5,
        shN=draw.normal(count, bands, 3) * 0.15,
        viewmat=_random_pose(draw),
        K=torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]),
        width=width,
        height=height,
        sh_degree=sh_degree,
        v_image=draw.normal(height, width, 3),
        v_alpha=draw.normal(height, width),
        means2d_offset=torch.zeros(count, 2) if draw.chance(0.5) else None,
        settings=RasterSettings(
            antialiased=draw.chance(0.4),
            absgrad=draw.chance(0.3),
            background=(0.2, 0.5, 0.9) if draw.chance(0.5) else (0.0, 0.0, 0.0),
        ),
        culling=CullingOptions(*(draw.chance(0.9) for _ in range(5))),
        needed=tuple(draw.chance(0.8) for _ in range(7)),
    )


def _random_pose(draw: Draw) -> Tensor:
    pose = torch.eye(4)
    pose[:3, :3] = rotation_matrices(draw.normal(1, 4).double())[0]
    pose[:3, 3] = draw.normal(3)
    return pose


def _place_in_world(scene: Scene) -> None:
    """Move the means from camera to world coordinates; keep what was made huge within float32."""
    rotation, shift = scene.viewmat[:3, :3].double(), scene.viewmat[:3, 3].double()
    means = ((scene.means.double() - shift) @ rotation).clamp(-FLOAT32_MAX, FLOAT32_MAX).float()
    scene.means = means
    for name in ("quats", "scales", "sh0", "shN"):
        value: Tensor = getattr(scene, name)
        setattr(scene, name, value.clamp(-FLOAT32_MAX, FLOAT32_MAX))


# --- checks -------------------------------------------------------------------------------------


def render(scene: Scene) -> tuple[Render, dict[str, Tensor]]:
    """The render, and its leaves: the parameters and the offset whose gradients are needed."""
    leaves = {
        name: value.detach().requires_grad_(needed)
        for (name, value), needed in zip(scene.tensors().items(), scene.needed, strict=False)
    }
    rendered = rasterizer.render(
        ActivatedGaussians(*(leaves[name] for name in PARAMETERS)),
        scene.camera,
        scene.settings,
        scene.sh_degree,
        leaves.get("means2d_offset"),
        culling=scene.culling,
    )
    return rendered, {name: leaf for name, leaf in leaves.items() if leaf.requires_grad}


def gradients_of(scene: Scene, rendered: Render, leaves: Mapping[str, Tensor]) -> dict[str, Tensor]:
    if not leaves:
        return {}
    outputs, incoming = (rendered.image, rendered.alpha), (scene.v_image, scene.v_alpha)
    values = torch.autograd.grad(
        outputs, list(leaves.values()), incoming, allow_unused=True, materialize_grads=True
    )
    return dict(zip(leaves, values, strict=True))


def check_scene(scene: Scene, *, compare: bool = False) -> str | None:
    """Assert what a scene must give; return the message of the error where it is refused."""
    refusal = None
    try:
        rendered, leaves = render(scene)
        check_image(rendered)
        gradients = gradients_of(scene, rendered, leaves)
    except (ValueError, MemoryError) as error:
        refusal = str(error)
    if refusal is not None:
        assert scene.cases, f"a plain scene is refused: {refusal}"
        assert REFUSAL.match(refusal), f"an error that names nothing: {refusal}"
        return refusal
    for name, gradient in gradients.items():
        assert torch.isfinite(gradient).all(), f"the gradient of {name} is silently not finite"
        hidden = gradient[~rendered.visible]
        assert (hidden == 0).all(), f"what is not visible has a gradient of {name}"
    if compare and LOSSY.isdisjoint(scene.cases):
        compare_with_torch(scene, rendered)
    return None


def check_image(rendered: Render) -> None:
    image, alpha = rendered.image.detach(), rendered.alpha.detach()
    assert torch.isfinite(image).all(), "the image is not finite"
    assert (image >= 0).all(), "the image is below 0"
    assert ((alpha >= 0) & (alpha <= 1)).all(), "alpha is not in 0..1"


def compare_with_torch(scene: Scene, rendered: Render) -> None:
    """Compare a plain scene as test_rasterizer.py does; of a hostile one, the image alone."""
    if _near_plane_is_close(scene):
        return
    arguments = scene.tensors(), scene.camera, scene.settings
    if not scene.cases:
        oracle.compare(*arguments, sh_degree=scene.sh_degree)
        return
    exact, single = (
        oracle.run(*arguments, "torch", dtype, sh_degree=scene.sh_degree)[0].image.detach()
        for dtype in (torch.float64, torch.float32)
    )
    error, allowed = ((each - exact).abs().max() for each in (rendered.image.detach(), single))
    scale = max(1.0, float(exact.max()))
    bound = oracle.FACTOR * allowed + (_threshold_step(scene.settings) + 1e-5) * scale
    assert error <= bound, f"the image errs by {error:.2g}"


def _near_plane_is_close(scene: Scene) -> bool:
    """Whether rounding decides if some Gaussian is in front of the near plane."""
    row, offset = scene.viewmat[2, :3].double(), scene.viewmat[2, 3].double()
    products = scene.means.double() * row  # [N, 3]
    depth, terms = products.sum(-1) + offset, products.abs().sum(-1) + offset.abs()
    return bool(((depth - scene.settings.near).abs() <= 1e-6 * terms).any())


def _threshold_step(settings: RasterSettings) -> float:
    """The largest weight of a Gaussian that is composited or not, as alpha or T is rounded."""
    # The transmittance in front of one that leaves transmittance_min.
    last = settings.transmittance_min / max(1 - settings.alpha_max, 1e-6)
    return max(settings.alpha_min, min(1.0, last))


# --- the command --------------------------------------------------------------------------------


def fuzz(seeds: Iterable[int]) -> dict[str, list[int]]:
    """Check the scenes of some seeds; return the errors with the seeds that were refused.

    One in 20 is compared with torch. An AssertionError names the seed of the scene and its cases.
    """
    refused: defaultdict[str, list[int]] = defaultdict(list)
    for seed in seeds:
        scene = random_scene(seed)
        try:
            error = check_scene(scene, compare=seed % 20 == 0)
        except AssertionError as failure:
            raise AssertionError(f"seed {seed} ({', '.join(scene.cases)}): {failure}") from failure
        if error is not None:
            refused[error].append(seed)
    return refused


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Fuzz the compiled rasterizer.")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--count", type=int, default=10_000, help="the number of scenes")
    options = parser.parse_args()
    torch.set_num_threads(1)  # the scenes are tiny
    found = fuzz(range(options.seed, options.seed + options.count))
    for message, of_one in found.items():
        print(f"{len(of_one):8} refused, first by seed {of_one[0]}: {message}")  # noqa: T201
