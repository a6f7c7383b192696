"""The topics of the MCAP logs that this package writes: one file for each episode.

Observation t and action t have the time of step t; reward t, which follows the action, has the time
of step t + 1, like the observation after it.
"""

from __future__ import annotations

from typing import Any

SUFFIX = ".mcap"
OBSERVATION = "/observation"
ACTION = "/action"
REWARD = "/reward"
DECISION = "/decision"
METADATA = "spikeserve"  # the name of the metadata record
FORMAT = "spikeserve.mcap.v1"
NANOSECONDS = 1_000_000_000

_NUMBER = {"type": "number"}
_NUMBERS = {"type": "array", "items": _NUMBER}


def _schema(title: str, **properties: Any) -> dict[str, Any]:
    return {"title": f"spikeserve.{title}", "type": "object", "properties": properties}


# By topic. Foxglove plots their fields, such as /observation.values[0].
SCHEMAS = {
    OBSERVATION: _schema("Observation", values=_NUMBERS),
    ACTION: _schema("Action", values=_NUMBERS),
    REWARD: _schema("Reward", value=_NUMBER),
    DECISION: _schema("Decision", return_to_go=_NUMBER, spikes=_NUMBER),
}
