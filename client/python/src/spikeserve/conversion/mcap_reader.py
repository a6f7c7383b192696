"""Reads MCAP logs: each file is an episode, and each message of the action's topic is a step."""

from __future__ import annotations

import contextlib
import json
import math
import pathlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.conversion import mcap_layout as layout
from spikeserve.conversion.data import (
    Episode,
    RobotData,
    Selection,
    action_space_of,
    check_episode,
    environment_name,
    space_from_json,
)
from spikeserve.conversion.messages import numbers_of
from spikeserve.conversion.packages import package

_ENCODINGS = "json, cdr with a ros2msg schema, or protobuf"


@dataclass
class _Series:
    """The messages of one topic: times in nanoseconds, and the numbers of a field."""

    times: list[int] = field(default_factory=list)
    rows: list[NDArray[np.float64]] = field(default_factory=list)
    integers: bool = True  # so far

    def add(self, time: int, row: NDArray[Any], where: str) -> None:
        if self.rows:
            size = len(self.rows[0])
            expected = f"{size} numbers, as in the first message"
            check(len(row) == size, where, expected, len(row))
        self.integers = self.integers and np.issubdtype(row.dtype, np.integer)
        self.times.append(time)
        self.rows.append(row.astype(np.float64))


def files_of(source: pathlib.Path) -> list[pathlib.Path]:
    """Returns the logs of a folder, or the log itself."""
    return [source] if source.is_file() else sorted(source.rglob(f"*{layout.SUFFIX}"))


def read_mcap(source: pathlib.Path, selection: Selection) -> RobotData:
    """Reads the logs below `source`, an episode each.

    A step is a message of the action's topic. Its observation is the last message of each
    observation topic at or before it, and its reward the sum of the rewards after it, up to the
    next action. The last observation is the one after the last action, or NaN.
    """
    logs = [_read_log(path, selection) for path in files_of(source)]
    check(bool(logs), str(source), f"files *{layout.SUFFIX}", "none")
    first = logs[0]
    notes = [note for log in logs for note in log.notes]
    name = f"{source}: topic {selection.action or layout.ACTION}"
    # What a log says about itself holds for the topics that it was written with.
    ours = not (selection.action or selection.actions or selection.action_low)
    if ours and all(log.metadata for log in logs):
        where = f"{first.path}: metadata {layout.METADATA}: action_space"
        space = space_from_json(_parse(first.metadata.get("action_space", ""), where), where)
        discrete = hasattr(space, "n")
        actions = [
            log.actions[:, 0].astype(np.int64) if discrete else log.actions.astype(np.float32)
            for log in logs
        ]
    else:
        sizes = {log.actions.shape[1] for log in logs}
        check(len(sizes) == 1, name, "as many numbers in every log", sorted(sizes))
        space, actions, space_notes = action_space_of(
            [log.actions for log in logs], selection, name
        )
        notes += space_notes
    default = first.metadata.get("environment") or source.resolve().stem
    data = RobotData(
        environment_name(selection, default),
        space,
        [],
        selection.fps or first.fps,
        first.names("observation_names", first.observations.shape[1]),
        first.names("action_names", first.actions.shape[1]),
        list(dict.fromkeys(notes)),
    )
    for log, action in zip(logs, actions, strict=True):
        episode = log.episode(action, selection)
        data.episodes.append(episode)
        check_episode(data, episode, str(log.path))
    return data


@dataclass
class _Log:
    path: pathlib.Path
    observations: NDArray[np.float32]  # [T + 1, obs]
    actions: NDArray[Any]  # [T, size]
    rewards: NDArray[np.float64]  # [T]
    fps: float | None
    metadata: dict[str, str]
    notes: list[str]

    def names(self, key: str, size: int) -> tuple[str, ...]:
        stored = _parse(self.metadata.get(key, "[]"), f"{self.path}: metadata: {key}")
        usable = isinstance(stored, list) and len(stored) == size
        return tuple(str(name) for name in stored) if usable else ()

    def episode(self, actions: NDArray[Any], selection: Selection) -> Episode:
        def value(key: str, kind: type, default: Any) -> Any:
            if key not in self.metadata:
                return default
            where = f"{self.path}: metadata {layout.METADATA}: {key}"
            parsed = _parse(self.metadata[key], where)
            check(type(parsed) is kind, where, kind.__name__, self.metadata[key])
            return parsed

        return Episode(
            observations=self.observations,
            actions=actions,
            rewards=self.rewards,
            terminated=value("terminated", bool, False),
            truncated=value("truncated", bool, True),
            seed=value("seed", int, 0),
            actor=self.metadata.get("actor", "unknown"),
            task=selection.task or self.metadata.get("task", ""),
        )


def _parse(text: str, where: str) -> Any:
    try:
        return json.loads(text)
    except ValueError as error:
        raise ValueError(f"{where}: expected JSON, received {text!r}") from error


def _read_log(path: pathlib.Path, selection: Selection) -> _Log:
    observation = selection.observation or (layout.OBSERVATION,)
    wanted = [*observation, selection.action or layout.ACTION]
    reward = selection.reward or layout.REWARD
    make_reader, decoders = package("mcap.reader").make_reader, _decoders()
    with path.open("rb") as file:
        with _reading(path):
            reader = make_reader(file, validate_crcs=True, decoder_factories=decoders)
            summary = reader.get_summary()
        check(summary is not None, str(path), "a log with a summary", "none")
        topics = {channel.topic for channel in summary.channels.values()}
        if selection.reward or reward in topics:
            wanted.append(reward)
        else:
            reward = ""
        series = _read_series(path, reader, topics, wanted)
        with _reading(path):
            metadata = _read_metadata(reader)
    ours = metadata if metadata.get("format") == layout.FORMAT else {}
    return _align(path, series, wanted, reward, ours)


@contextlib.contextmanager
def _reading(path: pathlib.Path) -> Iterator[None]:
    """Turns an error of the library into a ValueError. Damaged logs raise errors of many types."""
    try:
        yield
    except package("mcap.exceptions").DecoderNotFoundError as error:
        raise ValueError(
            f"{path}: expected messages in {_ENCODINGS}, whose decoders are mcap-ros2-support and "
            f"mcap-protobuf-support, received: {error}"
        ) from error
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".rstrip(": ")
        raise ValueError(
            f"{path}: expected an MCAP log, received damaged data: {reason}; `mcap recover` of "
            "Foxglove's command line keeps what can be read"
        ) from error


def _decoders() -> list[Any]:
    factories = [_json_decoder()]
    for module in ("mcap_ros2.decoder", "mcap_protobuf.decoder"):
        try:
            factories.append(package(module).DecoderFactory())
        except ValueError:  # messages of this encoding are refused by name when there are any
            continue
    return factories


def _json_decoder() -> Any:
    class JsonDecoder(package("mcap.decoder").DecoderFactory):  # type: ignore[misc]
        def decoder_for(self, encoding: str, _schema: Any) -> Callable[[bytes], Any] | None:
            return json.loads if encoding == "json" else None

    return JsonDecoder()


def _topic_of(name: str, topics: set[str], where: str) -> tuple[str, str]:
    """Splits `/topic.field` into the longest topic that exists, and the field or ""."""
    found = [topic for topic in topics if name == topic or name.startswith(topic + ".")]
    flags = "--observation, --action and --reward select other ones"
    known = ", ".join(sorted(topics)) or "no topics"
    check(bool(found), f"{where}: {name}", f"a topic of the log ({known}); {flags}", "none")
    topic = max(found, key=len)
    return topic, name[len(topic) + 1 :]


def _read_series(
    path: pathlib.Path, reader: Any, topics: set[str], wanted: list[str]
) -> dict[str, _Series]:
    by_topic: dict[str, list[tuple[str, str]]] = {}
    for name in wanted:
        topic, member = _topic_of(name, topics, str(path))
        by_topic.setdefault(topic, []).append((name, member))
    series = {name: _Series() for name in wanted}
    messages = reader.iter_decoded_messages(topics=list(by_topic), log_time_order=True)
    while True:
        with _reading(path):
            read = next(messages, None)
        if read is None:
            break
        for name, member in by_topic[read.channel.topic]:
            where = f"{path}: {name}: message {len(series[name].rows)}"
            row = numbers_of(read.decoded_message, member, where)
            series[name].add(read.message.log_time, row, where)
    for name, messages_of_it in series.items():
        check(bool(messages_of_it.rows), f"{path}: {name}", "messages", "none")
    return series


def _read_metadata(reader: Any) -> dict[str, str]:
    for record in reader.iter_metadata():
        if record.name == layout.METADATA:
            return dict(record.metadata)
    return {}


def _align(
    path: pathlib.Path,
    series: dict[str, _Series],
    wanted: list[str],
    reward: str,
    metadata: dict[str, str],
) -> _Log:
    observed = [series[name] for name in wanted[: len(wanted) - (2 if reward else 1)]]
    action = series[wanted[len(observed)]]
    times = np.asarray(action.times, np.int64)
    # Actions before the first observation of every topic belong to no step.
    start = max(s.times[0] for s in observed)
    first = int(np.searchsorted(times, start, side="left"))
    expected = "an action after the first message of every observation topic"
    check(first < len(times), str(path), expected, "none")
    notes = [f"{path}: left out {first} actions before the first observation"] if first else []
    times = times[first:]
    rows = [
        np.stack([s.rows[i] for i in np.searchsorted(s.times, times, side="right") - 1])
        for s in observed
    ]
    later = all(s.times[-1] > times[-1] for s in observed)
    last = [s.rows[-1] if later else np.full_like(s.rows[-1], np.nan) for s in observed]
    observations = np.concatenate(
        [np.concatenate(rows, axis=1), np.concatenate(last)[np.newaxis]]
    ).astype(np.float32)
    rewards = np.zeros(len(times))
    if reward:
        numbers = np.stack(series[reward].rows)
        check(numbers.shape[1] == 1, f"{path}: {reward}", "one number", numbers.shape[1])
        step = np.searchsorted(times, series[reward].times, side="left") - 1
        np.add.at(rewards, step[step >= 0], numbers[step >= 0, 0])
    else:
        notes.append("rewards: 0, because there is no topic " + layout.REWARD)
    actions = np.stack(action.rows[first:])
    interval = float(np.median(np.diff(times))) if len(times) > 1 else math.inf
    fps = layout.NANOSECONDS / interval if 0 < interval < math.inf else None
    if "fps" in metadata:
        fps = _parse(metadata["fps"], f"{path}: metadata: fps")
    return _Log(
        path=path,
        observations=observations,
        actions=actions.astype(np.int64) if action.integers else actions,
        rewards=rewards,
        fps=fps,
        metadata=metadata,
        notes=notes,
    )
