"""Formulas of the site; a workflow builds it strictly, so that each page is made and linked."""

from __future__ import annotations

import html
import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_formulas_are_mathml() -> None:
    spec = importlib.util.spec_from_file_location("site_hooks", ROOT / "docs" / "site_hooks.py")
    assert spec is not None
    assert spec.loader is not None
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    page = (ROOT / "docs/rasterizer.md").read_text(encoding="utf-8")
    content = "\n".join(
        f'<div class="arithmatex">\\[{html.escape(formula)}\\]</div>'
        for formula in re.findall(r"\$\$(.*?)\$\$", page, re.DOTALL)
    )
    made = hooks.on_page_content(content, None, None, None)
    elements = set(re.findall(r"<(\w+)", made))
    assert {"math", "msqrt", "mfrac", "mtable"} <= elements
    assert "<span>(32)</span>" in made
    assert r"\bar" not in made
