"""Evaluates trained Gaussians: the frozen evaluation protocol and the metrics."""
