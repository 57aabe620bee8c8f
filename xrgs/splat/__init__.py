"""The model: Gaussians, cameras, rasterizer, loss, optimizer, densification.

Knows nothing of XR-GS, scenes or Hydra: it could be its own package.
"""
