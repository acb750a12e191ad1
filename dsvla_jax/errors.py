"""The one exception that the programs turn into a message instead of a traceback."""


class UserError(ValueError):
    """The input is at fault, not the code: the message names what was wrong, what was expected, and the fix."""
