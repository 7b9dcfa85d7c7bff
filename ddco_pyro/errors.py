"""The base of errors that tell a user what to change."""


class BadInput(ValueError):
    """What was given cannot be used: one line that says what is wrong, where, and what to do (exit status 2)."""
