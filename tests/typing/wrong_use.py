"""Wrong uses of the public API; mypy must find an error of the named code at each such line."""

import xrgs
from xrgs import Camera, RasterSettings, load_ply, rasterize

gaussians = load_ply("splats.ply")
camera = Camera.look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), width=640, height=480)
xrgs.rasterise(gaussians)  # error: attr-defined
load_ply(3)  # error: arg-type
rasterize(camera, gaussians)  # error: arg-type
rasterize(gaussians, camera, degree=3)  # error: call-arg
image = rasterize(gaussians, camera).colors  # error: attr-defined
RasterSettings(near="0.01")  # error: arg-type
xrgs.rasterization(gaussians.means)  # error: call-arg
xrgs.Store("store").cells(verified=True)  # error: call-arg
xrgs.train(gaussians, xrgs.compose())  # error: arg-type
