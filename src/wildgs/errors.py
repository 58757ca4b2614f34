"""What goes wrong by a user's mistake, as opposed to a fault of this program."""


class UserError(Exception):
    """A mistake that the user can mend.

    The message is one line: what is wrong (with the file's name) and what to do. The command line prints it
    without a traceback and exits with code 2.
    """


class WildGSWarning(UserWarning):
    """Something was left out and work continues; the message says what is lost and how to get it."""


class ReportedError(UserError):
    """A mistake that another process of the same training tells the user about: this one ends in silence."""
