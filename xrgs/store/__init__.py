"""Cells: their identity, their results, and the store that keeps them."""
