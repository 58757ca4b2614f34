"""Exceptions and warnings of the package."""


class UserError(Exception):
    """An error that the user can correct, such as a missing file or an invalid option.

    The message is one line: what is wrong (with the file's name) and what to do. The command line prints it
    without a traceback and exits with code 2.
    """


class WildGSWarning(UserWarning):
    """Work continues without something; the message says what is missing and how to get it."""


class ReportedError(UserError):
    """An error that another process of a distributed training reports; this process exits without a message."""
