"""Trains one cell: the loop, its components and its checkpoints."""
