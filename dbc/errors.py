"""The two kinds of error that people see as one line; every other exception is our own bug and is raised.

They are here because this is the package that all others may import.
"""


class UserMistake(Exception):  # noqa: N818 - says whose fault it is, which "Error" would not
    """Something asked for, or a file given, is not usable; the text names it and what is allowed. Exit code 2."""


class SetupFailure(Exception):  # noqa: N818
    """The machine or its set-up does not allow what was asked for; the text says what to do. Exit code 3."""
