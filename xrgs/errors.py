"""Errors that a user can mend. Their message is all that a command prints of them."""


class XrgsError(Exception):
    """Something outside the program is wrong: the message names the file, key or parameter."""
