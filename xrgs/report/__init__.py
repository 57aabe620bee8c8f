"""Makes tables and figures of a sweep, only from its store: without training, without torch."""

from xrgs.report.collect import Choice
from xrgs.report.compare import Design
from xrgs.report.page import Report, build

__all__ = ["Choice", "Design", "Report", "build"]
