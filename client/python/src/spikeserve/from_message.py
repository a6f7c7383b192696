"""`FromMessage`: plain values that are made from messages of the wire contract."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

from spikeserve.wire import Message

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on

# Converts messages within other ones, by their names.
CONVERTERS: dict[str, Callable[[Message], Any]] = {}


class FromMessage:
    """A dataclass whose fields are those of the message `message`.

    `_others` makes those that `plain` does not. What neither has keeps its default.
    """

    _readers: ClassVar[dict[str, Callable[[Message], Any]]]

    def __init_subclass__(cls, message: str = "") -> None:
        CONVERTERS[message or cls.__name__] = cls.from_wire

    @classmethod
    def from_wire(cls, message: Message) -> Self:
        """Converts a message of the wire contract."""
        values = cls._others(message)
        if "_readers" not in cls.__dict__:
            fields: dict[str, Any] = cls.__dataclass_fields__  # type: ignore[attr-defined]
            cls._readers = {
                name: reader(message, name, optional=field.type.endswith("| None"))
                for name, field in fields.items()
                if name not in values and name in message.DESCRIPTOR.fields_by_name
            }
        for name, read in cls._readers.items():
            values[name] = read(message)
        return cls(**values)

    @classmethod
    def _others(cls, message: Message) -> dict[str, Any]:
        return {}


def reader(message: Message, field: str, optional: bool) -> Callable[[Message], Any]:
    """Returns what makes a number, text, tuple or dict of a field of such messages.

    It returns None for an `optional` field that is not set.
    """
    described = message.DESCRIPTOR.fields_by_name[field]
    if described.enum_type is not None:
        return functools.partial(enum_name, field=field)
    convert = _converter(described, getattr(message, field))
    if optional and described.has_presence:
        return lambda each: convert(getattr(each, field)) if each.HasField(field) else None
    return lambda each: convert(getattr(each, field))


def _converter(described: Any, value: Any) -> Callable[[Any], Any]:
    if isinstance(value, str | bytes | float | int):
        return lambda plain: plain
    if hasattr(value, "items"):
        return dict
    if described.message_type is None:
        return tuple
    convert = CONVERTERS[described.message_type.name]
    return convert if described.has_presence else lambda values: tuple(map(convert, values))


def enum_name(message: Message, field: str) -> str:
    """Returns the name of the value of an enum field, or its number if the name is unknown."""
    value = getattr(message, field)
    known = message.DESCRIPTOR.fields_by_name[field].enum_type.values_by_number
    return known[value].name if value in known else str(value)
