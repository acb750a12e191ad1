"""The exceptions that the programs turn into a message instead of a traceback."""

import copyreg


class UserError(ValueError):
    """The input is at fault, not the code: the message names what was wrong, what was expected, and the fix."""


class DataError(UserError):
    """Recorded data that must not be used: says which file and field, what was expected, and what to do about it."""

    def __init__(self, where: object, field: str, expected: str, got: str, fix: str) -> None:
        super().__init__(f"{where}: {field}: expected {expected}, got {got}; {fix}")

    def __reduce__(self) -> tuple[object, ...]:
        # Made from its whole message again when it comes back from a worker process.
        return copyreg.__newobj__, (type(self), *self.args)  # pyright: ignore[reportAttributeAccessIssue]
