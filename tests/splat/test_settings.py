"""The settings of densification against the defaults of gsplat's strategy."""

from __future__ import annotations

from xrgs.splat.settings import DensifySettings


def test_the_settings_are_gsplats() -> None:
    from gsplat.strategy import DefaultStrategy

    names = {
        "start": "refine_start_iter",
        "stop": "refine_stop_iter",
        "every": "refine_every",
        "reset_every": "reset_every",
        "grow_grad2d": "grow_grad2d",
        "grow_scale3d": "grow_scale3d",
        "prune_opacity": "prune_opa",
        "prune_scale3d": "prune_scale3d",
    }
    strategy = DefaultStrategy()
    for mine, theirs in names.items():
        assert getattr(DensifySettings(), mine) == getattr(strategy, theirs)
    # `adjust_steps` of its trainer: int(steps * factor), each for itself.
    for steps in (300, 1000, 3000, 7000, 8700, 29_999, 30_000, 60_000):
        scaled = DensifySettings().scaled(steps)
        for name in ("start", "stop", "every", "reset_every"):
            expected = int(getattr(strategy, names[name]) * (steps / 30_000))
            assert getattr(scaled, name) == max(expected, 1 if "every" in name else 0)
    assert DensifySettings().scaled(10).every == 1
