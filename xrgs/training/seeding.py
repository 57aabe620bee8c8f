"""Random generators of a training run: one for each purpose, all derived from one seed."""

from __future__ import annotations

import torch

from xrgs.safeio.hashing import digest


def seeded_generator(seed: int, purpose: str) -> torch.Generator:
    """Make the random generator of one purpose.

    Each purpose has a generator of its own, so that a change in how many numbers one of them draws
    does not change what the others draw.

    Args:
        seed: `seed` of the config.
        purpose: What the numbers are drawn for: `init`, `views` or `densify`.

    Returns:
        A generator on the CPU, in the same state for the same arguments.
    """
    return torch.Generator().manual_seed(int(digest([seed, purpose])[:15], 16))
