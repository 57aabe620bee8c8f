"""The report as one HTML file, which needs no network, no server and no other file."""

from xrgs.report.html.document import write_document

__all__ = ["write_document"]
