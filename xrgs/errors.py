"""The errors that a user can fix: a command prints their message alone, without a traceback."""


class XrgsError(Exception):
    """Something outside the program is wrong; the message names the file, key or parameter."""


class StoreError(XrgsError):
    """A store can't be used, or one of its files is missing, damaged or not what it should be."""


class UnreadableError(StoreError):
    """A file can't be read now, because of its permissions or because a disk or a server fails.

    Nothing is known of its content: it is neither missing nor damaged, and is to be read again.
    """
