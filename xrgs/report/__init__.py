"""Tables and figures of a sweep, made from its store alone, without training and without torch."""

from xrgs.report.compare import Design
from xrgs.report.joined import Choice
from xrgs.report.page import Report, build

__all__ = ["Choice", "Design", "Report", "build"]
