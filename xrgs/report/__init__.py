"""From a store to tables and figures, without training and without torch."""

from xrgs.report.page import Report, build

__all__ = ["Report", "build"]
