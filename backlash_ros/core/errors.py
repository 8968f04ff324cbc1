"""The error a user can cause, and how it is worded."""


class ParameterError(ValueError):
    """A parameter breaks a rule: the message names it, its value, the rule and the cure."""

    def __init__(self, name: str, value: object, rule: str, cure: str = '') -> None:
        self.name = name
        message = f'{name}={value!r} {rule}'
        super().__init__(f'{message}: {cure}' if cure else message)
