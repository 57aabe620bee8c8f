"""Notices that a store was moved, deleted or unmounted while a sweep uses it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.errors import StoreError

if TYPE_CHECKING:
    from xrgs.experiment.store import Store


class StoreGoneError(StoreError):
    """The store is no longer where it was. Nothing may be created there."""


def is_gone(store: Store) -> bool:
    """Tell whether a store that was prepared is no longer there.

    An empty folder in its place, as an unmounted disk leaves it, is no store. A store that can't be
    looked at now is not gone.

    Args:
        store: The store.
    """
    try:
        return not store.exists
    except StoreError:
        return False


def check(store: Store) -> None:
    """Do nothing while a store is there.

    Args:
        store: The store.

    Raises:
        StoreGoneError: It is no longer there; the message says what has become of its cells.
    """
    if is_gone(store):
        raise StoreGoneError(
            f"store={store.path}: it is no longer there (moved or deleted?); finished cells are"
            " where the store went: run the same command again with store= naming that folder"
        )
