"""Train the photographs of a cell with gsplat itself, on a GPU.

    python examples/train_with_gsplat.py save CELL scene --store xrgs-store
    python examples/train_with_gsplat.py train scene renders/fern --seed 0
    xrgs-report --external gsplat:renders

The steps may run on different machines. `save` writes the photographs, the cameras and the SfM
points of a cell. `train` needs only torch, numpy, Pillow and gsplat 1.5.3, and a GPU. It follows
gsplat's `examples/simple_trainer.py` with its default settings: same initialisation, learning
rates, loss and order of operations, and gsplat's own `rasterization` and `DefaultStrategy`. It
writes a render of each test view, which a report scores beside the cells of its sweep.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional


class View(NamedTuple):
    """A view in the folder that `save` writes."""

    name: str
    viewmat: Tensor  # [4, 4] world to camera
    K: Tensor  # [3, 3] px
    width: int
    height: int
    photograph: Tensor | None
    """[H, W, 3], uint8; None for a test view."""


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    save_, train_ = (commands.add_parser(name) for name in ("save", "train"))
    save_.add_argument("cell", help="the id of a trained cell, or the beginning of one")
    save_.add_argument("scene", type=Path, help="the folder to write")
    save_.add_argument("--store", default="xrgs-store", help="default: %(default)s")
    train_.add_argument("scene", type=Path, help="the folder that `save` wrote")
    train_.add_argument("renders", type=Path, help="the folder to write")
    train_.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    train_.add_argument("--steps", type=int, default=30000, help="max_steps (default: %(default)s)")
    train_.add_argument("--device", default="cuda", help="default: %(default)s, as gsplat needs")
    resets = "reset opacities every 3,000 steps, which gsplat 1.5.3 means to do and never does"
    train_.add_argument("--resets", action="store_true", help=resets)
    scale = "times the scene's scale: larger Gaussians are pruned; 10 keeps them (default: 0.1)"
    train_.add_argument("--prune-scale3d", type=float, default=0.1, help=scale)
    return parser.parse_args(arguments)


def save(options: argparse.Namespace) -> None:
    """Write the photographs, cameras and SfM points of a cell."""
    import xrgs

    data = xrgs.Store(options.store).find_cell(options.cell).dataset()
    options.scene.mkdir(parents=True, exist_ok=True)
    for view in data.train:
        if view.mask is not None:
            raise SystemExit(f"{view.name} has a mask, which gsplat's trainer does not read")
        Image.fromarray(view.pixels.numpy()).save(options.scene / f"{view.name}.png")
    views = [*data.train, *data.test]
    np.savez_compressed(
        options.scene / "scene.npz",
        names=[view.name for view in views],
        viewmats=torch.stack([view.camera.viewmat for view in views]),
        Ks=torch.stack([view.camera.K for view in views]),
        sizes=[(view.camera.width, view.camera.height) for view in views],
        points=data.points,
        colors=data.colors,
        scene_scale=data.scene_scale,
    )


def read_views(scene: Path, arrays: Any, device: str) -> Iterator[View]:
    """Read the photographs and the cameras onto a device."""
    keys = ("names", "viewmats", "Ks", "sizes")
    for name, viewmat, K, (width, height) in zip(*(arrays[key] for key in keys), strict=True):
        file = scene / f"{name}.png"
        photograph = None
        if file.exists():
            photograph = torch.tensor(np.array(Image.open(file)), device=device)
        camera = [torch.tensor(matrix, device=device) for matrix in (viewmat, K)]
        yield View(str(name), camera[0], camera[1], int(width), int(height), photograph)


def initial_splats(points: Tensor, colors: Tensor, device: str) -> torch.nn.ParameterDict:
    """Place a Gaussian on each point (`create_splats_with_optimizers` of gsplat's trainer)."""
    squared = torch.cdist(points, points).topk(4, largest=False).values[:, 1:].square()
    harmonics = torch.zeros((len(points), 16, 3))
    harmonics[:, 0] = (colors - 0.5) / 0.28209479177387814
    splats = {
        "means": points,
        "scales": squared.mean(dim=1).sqrt().log()[:, None].repeat(1, 3),
        "quats": torch.rand((len(points), 4)),
        "opacities": torch.logit(torch.full((len(points),), 0.1)),
        "sh0": harmonics[:, :1],
        "shN": harmonics[:, 1:],
    }
    return torch.nn.ParameterDict({name: value.to(device) for name, value in splats.items()})


def ssim(first: Tensor, second: Tensor) -> Tensor:
    """Return the mean SSIM of two images [H, W, 3] over the windows that lie inside [wang2004]."""
    offsets = torch.arange(11, device=first.device) - 5.0
    taps = torch.exp(-offsets.square() / (2 * 1.5**2))
    taps = (taps / taps.sum()).expand(15, 1, 11)
    a, b = first.permute(2, 0, 1), second.permute(2, 0, 1)
    maps = torch.cat([a, b, a * a, b * b, a * b])[None]  # [1, 15, H, W]
    rows = functional.conv2d(maps, taps[:, :, None, :], groups=15)
    mean_a, mean_b, aa, bb, ab = functional.conv2d(rows, taps[..., None], groups=15)[0].chunk(5)
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structure = (2 * (ab - mean_a * mean_b) + c2) / (aa - mean_a**2 + bb - mean_b**2 + c2)
    return torch.mean(luminance * structure)


def render(splats: torch.nn.ParameterDict, view: View, sh_degree: int) -> tuple[Tensor, Any]:
    """Return gsplat's render [H, W, 3] of a view, and the `info` for its strategy."""
    from gsplat import rasterization

    image, _, info = rasterization(
        means=splats["means"],
        quats=splats["quats"],
        scales=torch.exp(splats["scales"]),
        opacities=torch.sigmoid(splats["opacities"]),
        colors=torch.cat([splats["sh0"], splats["shN"]], dim=1),
        viewmats=view.viewmat[None],
        Ks=view.K[None],
        width=view.width,
        height=view.height,
        sh_degree=sh_degree,
        near_plane=0.01,
        far_plane=1e10,
        packed=False,
    )
    return image[0], info


def make_optimizers(
    splats: torch.nn.ParameterDict, scene_scale: float
) -> dict[str, torch.optim.Optimizer]:
    """Make an Adam for each parameter, with the learning rates of gsplat's trainer."""
    rates = {
        "means": 1.6e-4 * scene_scale,
        "scales": 5e-3,
        "quats": 1e-3,
        "opacities": 5e-2,
        "sh0": 2.5e-3,
        "shN": 2.5e-3 / 20,
    }
    return {
        name: torch.optim.Adam([splats[name]], lr=rate, eps=1e-15, fused=True)
        for name, rate in rates.items()
    }


def train(options: argparse.Namespace) -> None:
    """Train as gsplat's trainer does, and render the test views."""
    from gsplat import DefaultStrategy
    from gsplat.strategy.ops import reset_opa

    torch.manual_seed(options.seed)
    arrays, device = np.load(options.scene / "scene.npz"), options.device
    views = list(read_views(options.scene, arrays, device))
    training = [(view, view.photograph) for view in views if view.photograph is not None]
    scene_scale = float(arrays["scene_scale"])
    points, colors = (torch.from_numpy(arrays[name]) for name in ("points", "colors"))
    splats = initial_splats(points, colors, device)
    optimizers = make_optimizers(splats, scene_scale)
    decay = torch.optim.lr_scheduler.ExponentialLR(
        optimizers["means"], gamma=0.01 ** (1 / options.steps)
    )
    strategy = DefaultStrategy(prune_scale3d=options.prune_scale3d)
    state = strategy.initialize_state(scene_scale=scene_scale)
    start = time.perf_counter()
    order: list[int] = []
    for step in range(options.steps):
        order = order or torch.randperm(len(training)).tolist()
        view, pixels = training[order.pop()]
        photograph = pixels / 255.0
        image, info = render(splats, view, min(step // 1000, 3))
        strategy.step_pre_backward(splats, optimizers, state, step, info)
        loss = 0.8 * (image - photograph).abs().mean() + 0.2 * (1 - ssim(image, photograph))
        loss.backward()  # type: ignore[no-untyped-call]
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        decay.step()
        strategy.step_post_backward(splats, optimizers, state, step, info)
        reset = step > 0 and step % strategy.reset_every == 0 and step < strategy.refine_stop_iter
        if options.resets and reset:
            reset_opa(splats, optimizers, state, value=2 * strategy.prune_opa)
        if step % 1000 == 0:
            seconds = time.perf_counter() - start
            print(f"step {step}: {len(splats['means']):,} Gaussians, {seconds:.0f} s", flush=True)
    final_loss = loss.item()  # waits for the GPU
    seconds = time.perf_counter() - start
    options.renders.mkdir(parents=True, exist_ok=True)
    write_renders(splats, [view for view in views if view.photograph is None], options.renders)
    record = {
        "gaussians": len(splats["means"]),
        "loss": final_loss,
        "seconds": seconds,
        "device": torch.cuda.get_device_name() if device == "cuda" else device,
        **{key: vars(options)[key] for key in ("seed", "steps", "resets", "prune_scale3d")},
    }
    (options.renders / "training.json").write_text(json.dumps(record, indent=1) + "\n")


@torch.no_grad()
def write_renders(splats: torch.nn.ParameterDict, views: Sequence[View], folder: Path) -> None:
    """Write the render of each view as an 8-bit PNG."""
    for view in views:
        pixels = (render(splats, view, 3)[0].clamp(0, 1) * 255).round().to(torch.uint8)
        Image.fromarray(pixels.cpu().numpy()).save(folder / f"{view.name}.png")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one of the two steps."""
    options = parse(arguments)
    {"save": save, "train": train}[options.command](options)


if __name__ == "__main__":
    main()
