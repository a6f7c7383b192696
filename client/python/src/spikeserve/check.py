"""The form of every error about an argument."""

from __future__ import annotations


def check(holds: bool, field: str, expected: str, received: object) -> None:
    """Raises ValueError "field: expected X, received Y" unless `holds`."""
    if not holds:
        raise ValueError(f"{field}: expected {expected}, received {received}")
