"""A scene's photographs made into a frozen mixed-resolution variant. Light until one is built."""

from xrgs.variant.frozen import CorruptVariant, build, failure, find, key, load
from xrgs.variant.views import SceneFailed, Variant, View

__all__ = [
    "CorruptVariant",
    "SceneFailed",
    "Variant",
    "View",
    "build",
    "failure",
    "find",
    "key",
    "load",
]
