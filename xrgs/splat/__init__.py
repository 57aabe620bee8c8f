"""The splatting model: Gaussians, cameras, rasterizer, loss, optimizer and densification.

The package is independent of XR-GS, scenes and Hydra. Each operation of a training step has a
public module here, which checks the arguments, and two implementations, in `torch/` and in
`native/`. `backend.implementation` chooses between them.
"""
