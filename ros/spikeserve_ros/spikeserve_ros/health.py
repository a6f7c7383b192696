"""What the node's diagnostics say. Pure functions, safe to call from many threads."""

from collections.abc import Mapping
from typing import Any, NamedTuple

OK, WARN, ERROR, STALE = range(4)  # as in diagnostic_msgs/DiagnosticStatus


class Health(NamedTuple):
    """A diagnostic status: its level, one line, and figures by name."""

    level: int
    message: str
    values: dict[str, str]


def health(now: Mapping[str, int], before: Mapping[str, int], stats: Mapping[str, Any], refusal: str) -> Health:
    """Returns the health since the last diagnostics.

    `now` and `before` count the beats by their source, at both times. `stats` are the pilot's. `refusal` is the last
    message that was refused since, or empty.
    """
    recent = {source: now[source] - before[source] for source in now}
    beats = sum(recent.values())
    values = {f"beats_{source}": str(count) for source, count in now.items()}
    values |= {name: str(value) for name, value in stats.items()}
    if refusal:
        values["last_refusal"] = refusal
    if not beats:
        return Health(STALE, "no beat", values)
    if recent["lost"]:
        return Health(ERROR, refusal or "no recent observation: safe action", values)
    if recent["safe"] and stats.get("stays_safe"):
        return Health(ERROR, "kept at the safe action by the server", values)
    if recent["safe"]:
        return Health(ERROR, "no answer of the server: safe action", values)
    if recent["held"] or recent["local"]:
        replaced = recent["held"] + recent["local"]
        return Health(WARN, f"{replaced} of {beats} actions without an answer of the server", values)
    return Health(WARN, refusal, values) if refusal else Health(OK, "every action is fresh", values)
