"""File formats of Gaussians, and rendering with gsplat's signature."""
