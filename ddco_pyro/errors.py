"""The bases of errors that tell a user what to change."""


class BadInput(ValueError):
    """What was given cannot be used: one line that says what is wrong, where, and what to do (exit status 2)."""


class Failed(RuntimeError):
    """What was asked for cannot be done, though the input is in order: one line as above (exit status 1)."""
