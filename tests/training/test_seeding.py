"""Each purpose draws from a generator of its own."""

from __future__ import annotations

import hashlib

from xrgs.training.seeding import seeded_generator


def test_a_seed_and_a_purpose_give_the_same_numbers_in_every_version() -> None:
    for seed, purpose in ((0, "init"), (0, "views"), (1, "init")):
        digits = hashlib.sha256(f'[{seed},"{purpose}"]'.encode()).hexdigest()[:15]
        assert seeded_generator(seed, purpose).initial_seed() == int(digits, 16)
