"""Random generators of a training run: one for each purpose, all derived from one seed."""

from __future__ import annotations

import torch

from xrgs.safeio.hashing import digest


def seeded_generator(seed: int, purpose: str) -> torch.Generator:
    """Make the random generator of one purpose.

    Each purpose has its own generator, so that drawing more numbers for one purpose does not change
    the numbers for another.

    Args:
        seed: `seed` of the config.
        purpose: `init`, `views`, `densify`, or a component's name for its purpose.

    Returns:
        A generator on the CPU, in the same state for the same arguments.
    """
    return torch.Generator().manual_seed(int(digest([seed, purpose])[:15], 16))
