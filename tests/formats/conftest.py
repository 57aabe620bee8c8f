"""The backends that the tests of gsplat's signature run on."""

from tests.splat.conftest import backend

__all__ = ["backend"]
