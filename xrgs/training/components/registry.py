"""The registry of components: temporary, see the merge of the training packages."""

from __future__ import annotations

_MODULES = {
    "loss_weighting": ("weighting", "loss_weighting", "texture"),
    "continuous_weighting": ("weighting", "continuous_weighting"),
    "adaptive_weighting": ("weighting", "adaptive_weighting", "texture"),
    "hybrid_schedule": ("weighting", "hybrid_schedule"),
    "region_weighting": ("weighting", "region_weighting", "texture"),
    "multiview_score": ("view_scores",),
    "error_score": ("view_scores", "texture"),
}


def modules_of(key: str) -> tuple[str, ...]:
    """Return the source files of a component."""
    if key in {"plugins", "count_matched"}:
        return ()
    return tuple(f"training/components/{name}.py" for name in _MODULES.get(key, (key,)))
