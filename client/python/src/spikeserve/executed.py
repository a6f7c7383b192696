"""`Executed`: an executed action, and who chose it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from spikeserve.check import check
from spikeserve.wire import Message, message_class

LONGEST_OPERATOR_ID = 128  # bytes
_KINDS = message_class("ActionSource").DESCRIPTOR.enum_types_by_name["Kind"].values
SOURCES = tuple(value.name.lower() for value in _KINDS)  # by their numbers on the wire


@dataclass(frozen=True)
class Executed:
    """An executed action and who chose it, for every argument `executed_action`.

        session.act(observation, reward, executed_action=Executed(1, "operator", "anna"))

    `source` is "policy", "operator", "safety_layer", "held", "local", "safe", "hold" or "unknown":
    the policy, if the action is the answered one. An operator may have an id of at most 128 bytes.
    ValueError for anything else. `Pilot` takes None as the action that it returned.
    """

    action: Any  # ActionLike or None
    source: str
    operator_id: str = ""

    def __post_init__(self) -> None:
        check(self.source in SOURCES, "source", f"one of {SOURCES}", repr(self.source))
        size = len(self.operator_id.encode())
        most = LONGEST_OPERATOR_ID if self.source == "operator" else 0
        check(size <= most, "operator_id", f"at most {most} bytes", size)

    @property
    def kind(self) -> int:
        """Returns the number of the source on the wire."""
        return SOURCES.index(self.source)


def source_of(executed: Any) -> tuple[int, str]:
    """Returns who chose an executed action: the number on the wire and the operator's id."""
    return (executed.kind, executed.operator_id) if isinstance(executed, Executed) else (0, "")


def source_to_wire(executed: Any) -> Message | None:
    """Returns who chose an executed action, or None if that is not said."""
    kind, operator_id = source_of(executed)
    return message_class("ActionSource")(kind=kind, operator_id=operator_id) if kind else None
