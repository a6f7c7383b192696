"""The error of values that users give."""


class ValueRefusedError(ValueError):
    """A parameter, a file or a message has a value that cannot be used. The text names the field."""

    def __init__(self, field: str, expected: str, received: object) -> None:
        super().__init__(f"{field}: expected {expected}, received {received!r}")
        self.field, self.expected, self.received = field, expected, received
