"""Evaluates trained Gaussians: the frozen protocol and the metrics that cells are compared by."""
