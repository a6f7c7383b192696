"""Writes MCAP logs with JSON messages, which Foxglove opens."""

from __future__ import annotations

import json
import pathlib
from typing import Any

from spikeserve.conversion import mcap_layout as layout
from spikeserve.conversion.data import Episode, RobotData, space_to_json
from spikeserve.conversion.packages import package

_DEFAULT_FPS = 30.0


def write_mcap(data: RobotData, folder: pathlib.Path) -> None:
    """Writes a file for each episode to `folder`, which exists and is empty."""
    for index, episode in enumerate(data.episodes):
        _write_episode(data, episode, folder / f"episode_{index:06d}{layout.SUFFIX}")


def _write_episode(data: RobotData, episode: Episode, path: pathlib.Path) -> None:
    with path.open("wb") as file:
        writer = package("mcap.writer").Writer(file)
        writer.start(profile="", library="spikeserve")
        channels = {}
        for topic, schema in layout.SCHEMAS.items():
            encoded = json.dumps(schema).encode()
            schema_id = writer.register_schema(schema["title"], "jsonschema", encoded)
            channels[topic] = writer.register_channel(topic, "json", schema_id)
        fps = data.fps or _DEFAULT_FPS

        def send(topic: str, step: int, message: dict[str, Any]) -> None:
            time = round(step * layout.NANOSECONDS / fps)
            encoded = json.dumps(message, allow_nan=False).encode()
            writer.add_message(channels[topic], time, encoded, time, sequence=step)

        rows = episode.observations if episode.has_last_observation else episode.observations[:-1]
        for step, row in enumerate(rows):
            if step > 0:
                send(layout.REWARD, step, {"value": float(episode.rewards[step - 1])})
            send(layout.OBSERVATION, step, {"values": row.tolist()})
            if step == episode.steps:
                break
            action = episode.actions[step]
            values = action.tolist() if episode.actions.ndim == 2 else [int(action)]
            send(layout.ACTION, step, {"values": values})
            if episode.served is not None:
                decision = {
                    "return_to_go": float(episode.served["returns_to_go"][step]),
                    "spikes": int(episode.served["spikes"][step]),
                }
                send(layout.DECISION, step, decision)
        if not episode.has_last_observation:
            send(layout.REWARD, episode.steps, {"value": float(episode.rewards[-1])})
        writer.add_metadata(layout.METADATA, _metadata(data, episode))
        writer.finish()


def _metadata(data: RobotData, episode: Episode) -> dict[str, str]:
    """Returns what a log has no message for. The values of MCAP's metadata are texts."""
    values: dict[str, Any] = {
        "format": layout.FORMAT,
        "environment": data.environment,
        "action_space": json.dumps(space_to_json(data.action_space)),
        "fps": json.dumps(data.fps),
        "task": episode.task,
        "actor": episode.actor,
        "seed": json.dumps(episode.seed),
        "terminated": json.dumps(episode.terminated),
        "truncated": json.dumps(episode.truncated),
        "observation_names": json.dumps(data.observation_names),
        "action_names": json.dumps(data.action_names),
    }
    return values
