"""The errors that a user can fix: a command prints their message alone, without a traceback."""


class XrgsError(Exception):
    """Something outside the program is wrong; the message names the file, key or parameter."""


class StoreError(XrgsError):
    """A store can't be used, or one of its files is missing, damaged or not what it should be."""
