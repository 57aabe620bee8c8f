"""The public API as a user's type checker sees it; checked by mypy and never run.

The lines with `type: ignore` are wrong on purpose: `mypy --strict` reports an ignore that is not
needed, so each of them says that mypy finds an error of this code there.
"""

from typing import Any, assert_type

import pandas as pd
from torch import Tensor

import xrgs
from xrgs import Camera, Gaussians, RasterSettings, Store, load_gaussians, rasterize
from xrgs.formats.gsplat_api import rasterization

gaussians = load_gaussians("splats.ply").gaussians
assert_type(gaussians, Gaussians)
assert_type(len(gaussians), int)
assert_type(gaussians.scales, Tensor)
xrgs.save_gaussians("copy.glb", gaussians, antialiased=True)
assert_type(xrgs.load_gaussians("copy.glb").gaussians, Gaussians)
assert_type(xrgs.load_gaussians("copy.glb").antialiased, bool)

camera = Camera.look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), width=640, height=480)
render = rasterize(gaussians, camera, settings=RasterSettings(antialiased=True), sh_degree=1)
assert_type(render, xrgs.Render)
assert_type(render.image, Tensor)
assert_type(xrgs.rasterize(gaussians, camera).alpha, Tensor)

colors, alphas, meta = rasterization(
    gaussians.means,
    gaussians.quats,
    gaussians.scales.exp(),
    gaussians.opacities.sigmoid(),
    gaussians.sh0,
    camera.viewmat[None],
    camera.K[None],
    640,
    480,
    sh_degree=0,
    render_mode="RGB+ED",
)
assert_type(colors, Tensor)
assert_type(alphas, Tensor)
assert_type(meta, dict[str, Any])

store = Store("store")
assert_type(store.cells(), pd.DataFrame)
cell = store.cell("0123456789abcdef")
assert_type(cell.scores(), pd.DataFrame)
assert_type(cell.history(), pd.DataFrame)
assert_type(cell.gaussians(), Gaussians)
assert_type(cell.cameras()["test"]["IMG_001"], Camera)

conf = xrgs.compose("preset=smoke", "scene=motorcycle")
assert_type(conf.train.steps, int)
data = xrgs.build_dataset(conf)
assert_type(data.test[0].image, Tensor)
assert_type(xrgs.train(data, conf).gaussians, Gaussians)
assert_type(xrgs.train(xrgs.load_dataset("variant", "hr_only"), conf).seconds, float)

xrgs.rasterise(gaussians)  # type: ignore[attr-defined]
load_gaussians(3)  # type: ignore[arg-type]
rasterize(camera, gaussians)  # type: ignore[arg-type]
rasterize(gaussians, camera, degree=3)  # type: ignore[call-arg]
image = rasterize(gaussians, camera).colors  # type: ignore[attr-defined]
RasterSettings(near="0.01")  # type: ignore[arg-type]
rasterization(gaussians.means)  # type: ignore[call-arg]
store.cells(verified=True)  # type: ignore[call-arg]
xrgs.train(gaussians, conf)  # type: ignore[arg-type]
