"""Files of Gaussians, and gsplat's signature."""
