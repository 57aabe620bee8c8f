"""Each purpose draws from a generator of its own."""

from __future__ import annotations

import hashlib

import torch

from xrgs.training.seeding import seeded_generator


def draw(seed: int, purpose: str) -> torch.Tensor:
    return torch.rand(8, generator=seeded_generator(seed, purpose))


def test_the_same_seed_and_purpose_draw_the_same_numbers() -> None:
    assert torch.equal(draw(3, "views"), draw(3, "views"))


def test_another_seed_or_purpose_draws_other_numbers() -> None:
    purposes = ("init", "views", "densify")
    draws = {tuple(draw(seed, purpose).tolist()) for seed in (0, 1) for purpose in purposes}
    assert len(draws) == 6


def test_a_seed_gives_the_same_numbers_in_every_version() -> None:
    digits = hashlib.sha256(b'[0,"init"]').hexdigest()[:15]
    assert seeded_generator(0, "init").initial_seed() == int(digits, 16)
