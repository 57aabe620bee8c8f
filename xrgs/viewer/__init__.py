"""Shows trained Gaussians: live in a browser, and as films along paths of cameras."""
