"""The splatting model: Gaussians, cameras, rasterizer, loss, optimizer and densification.

The package knows nothing of XR-GS, scenes or Hydra. Each operation that training repeats has a
public module here, which checks its arguments, and one implementation in `torch/` and one in
`native/`, which `backend.implementation` chooses between.
"""
