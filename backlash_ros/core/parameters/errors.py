"""The error a user can cause, and how it is worded."""

from __future__ import annotations

UNTOLD = object()  # in place of a value that has nothing to do with the error


class ParameterError(ValueError):
    """A parameter breaks a rule: the message names it, its value, the rule and the cure."""

    def __init__(self, name: str, value: object, rule: str, cure: str = '') -> None:
        self.name = name
        message = f'{name} {rule}' if value is UNTOLD else f'{name}={value!r} {rule}'
        super().__init__(f'{message}: {cure}' if cure else message)
