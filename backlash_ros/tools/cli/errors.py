"""Errors that end a tool with one line."""


class InputError(ValueError):
    """Something the user gave cannot be used: one line says what, why and, if known, the cure."""


class BrokenOffError(RuntimeError):
    """A run could not go on, although everything given was valid: one line says why."""
