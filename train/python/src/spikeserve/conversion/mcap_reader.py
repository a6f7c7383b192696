"""Reads MCAP logs: each log is an episode, and each message of the action's topic is a step."""

from __future__ import annotations

import contextlib
import json
import math
import pathlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.conversion import mcap_layout as layout
from spikeserve.conversion.bags import logs_of
from spikeserve.conversion.data import (
    Episode,
    RobotData,
    Selection,
    action_space_of,
    check_episode,
    environment_name,
    read_names,
    space_from_json,
)
from spikeserve.conversion.mcap_series import Series, Table
from spikeserve.conversion.messages import numbers_of
from spikeserve.conversion.packages import package

_ENCODINGS = "json, cdr with a ros2msg schema, or protobuf"


def read_mcap(source: pathlib.Path, selection: Selection) -> RobotData:
    """Reads the logs below `source`, an episode each; the parts of a split recording are one log.

    A step is a message of the action's topic. Its observation is the last message of each
    observation topic at or before it, and its reward the sum of the rewards after it, up to the
    next action. The last observation is the one after the last action, or NaN. Numbers that have
    names in their messages are matched by name, and have the order of the first log.
    """
    found, notes = logs_of(source)
    check(bool(found), str(source), f"files *{layout.SUFFIX}", "none")
    logs: list[_Log] = []
    for files in found:
        logs.append(_read_log(files, selection, logs[0] if logs else None))
    first = logs[0]
    notes += [note for log in logs for note in log.notes]
    name = f"{source}: topic {selection.action or layout.ACTION}"
    # What a log says about itself holds for the topics that it was written with.
    chosen = selection.action or selection.actions is not None
    ours = not (chosen or selection.has_bounds)
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
        first.fps if selection.fps is None else selection.fps,
        first.observation_names(),
        first.tables[first.action].names,
        list(dict.fromkeys(notes)),
    )
    if ours:
        names = ("observation_names", "action_names")
        read_names(data, {n: _parse(first.metadata.get(n, "[]"), str(first.path)) for n in names})
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
    tables: dict[str, Table]  # by selected topic
    observed: list[str]  # the topics of the observation
    action: str  # the topic of the action
    notes: list[str]

    def observation_names(self) -> tuple[str, ...]:
        """Returns the names of all elements, or () if no topic has names."""
        tables = {topic: self.tables[topic] for topic in self.observed}
        if not any(table.names for table in tables.values()):
            return ()
        if len(tables) == 1:
            return tables[self.observed[0]].names
        return tuple(
            f"{topic}.{name}"
            for topic, table in tables.items()
            for name in table.names or map(str, range(table.rows.shape[1]))
        )

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


def _read_log(files: list[pathlib.Path], selection: Selection, first: _Log | None) -> _Log:
    """Reads the files of one log. Names are in the order of the log `first`, if there is one."""
    wanted = [
        *(selection.observation or (layout.OBSERVATION,)),
        selection.action or layout.ACTION,
    ]
    reward = selection.reward or layout.REWARD
    metadata: dict[str, str] = {}
    with contextlib.ExitStack() as opened:
        readers = {path: _open(opened.enter_context(path.open("rb")), path) for path in files}
        topics = {path: _topics(reader, path) for path, reader in readers.items()}
        all_topics = set().union(*topics.values())
        has_reward = bool(selection.reward) or reward in all_topics
        if has_reward:
            wanted.append(reward)
        series = {name: Series() for name in wanted}
        by_topic: dict[str, list[tuple[str, str]]] = {}
        for name in wanted:
            topic, member = _topic_of(name, all_topics, str(files[0]))
            by_topic.setdefault(topic, []).append((name, member))
        for path, reader in readers.items():
            _read_series(path, reader, by_topic, series)
            with _reading(path):
                metadata = _read_metadata(reader) or metadata
    for name, messages_of_it in series.items():
        check(bool(messages_of_it.messages), f"{files[0]}: {name}", "messages", "none")
    ours = metadata if metadata.get("format") == layout.FORMAT else {}
    tables = {}
    for name, of_topic in series.items():
        tables[name] = of_topic.table(_own_names(files[0], ours, name))
        if first is not None and name in first.tables and name != reward:
            where = f"{files[0]}: {name}"
            tables[name].in_order_of(first.tables[name].names, where, str(first.path))
    observed = wanted[: len(wanted) - (2 if has_reward else 1)]
    return _align(files[0], tables, observed, wanted[len(observed)], reward, ours)


def _open(file: Any, path: pathlib.Path) -> Any:
    with _reading(path):
        make_reader = package("mcap.reader").make_reader
        return make_reader(file, validate_crcs=True, decoder_factories=_decoders())


def _topics(reader: Any, path: pathlib.Path) -> set[str]:
    with _reading(path):
        summary = reader.get_summary()
    check(summary is not None, str(path), "a log with a summary", "none")
    return {channel.topic for channel in summary.channels.values()}


def _own_names(path: pathlib.Path, metadata: dict[str, str], topic: str) -> tuple[str, ...]:
    """Returns the names that a log of this package has for the elements of its topics."""
    key = {layout.OBSERVATION: "observation_names", layout.ACTION: "action_names"}.get(topic, "")
    stored = _parse(metadata.get(key, "[]"), f"{path}: metadata: {key}")
    return tuple(map(str, stored)) if isinstance(stored, list) else ()


@contextlib.contextmanager
def _reading(path: pathlib.Path) -> Iterator[None]:
    """Turns an error of the library into a ValueError. Damaged logs raise errors of many types."""
    try:
        yield
    except MemoryError:
        raise
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
    path: pathlib.Path,
    reader: Any,
    by_topic: dict[str, list[tuple[str, str]]],
    series: dict[str, Series],
) -> None:
    messages = reader.iter_decoded_messages(topics=list(by_topic), log_time_order=True)
    while True:
        with _reading(path):
            read = next(messages, None)
        if read is None:
            return
        for name, member in by_topic[read.channel.topic]:
            where = f"{path}: {name}: message {len(series[name].messages)}"
            numbers = numbers_of(read.decoded_message, member, where)
            series[name].add(read.message.log_time, numbers, where)


def _read_metadata(reader: Any) -> dict[str, str]:
    for record in reader.iter_metadata():
        if record.name == layout.METADATA:
            return dict(record.metadata)
    return {}


def _align(
    path: pathlib.Path,
    tables: dict[str, Table],
    observed_topics: list[str],
    action_topic: str,
    reward: str,
    metadata: dict[str, str],
) -> _Log:
    observed = [tables[name] for name in observed_topics]
    action = tables[action_topic]
    times = np.asarray(action.times, np.int64)
    # Actions before the first observation of every topic belong to no step.
    start = max(s.times[0] for s in observed)
    first = int(np.searchsorted(times, start, side="left"))
    expected = "an action after the first message of every observation topic"
    check(first < len(times), str(path), expected, "none")
    left_out = first + action.left_out
    note = f"{path}: left out {left_out} actions before the first observation"
    notes = [note] if left_out else []

    times = times[first:]
    rows = [s.rows[np.searchsorted(s.times, times, side="right") - 1] for s in observed]
    later = all(s.times[-1] > times[-1] for s in observed)
    last = [s.rows[-1] if later else np.full_like(s.rows[-1], np.nan) for s in observed]
    observations = np.concatenate(
        [np.concatenate(rows, axis=1), np.concatenate(last)[np.newaxis]]
    ).astype(np.float32)
    rewards = np.zeros(len(times))
    if reward in tables:
        numbers = tables[reward].rows
        check(numbers.shape[1] == 1, f"{path}: {reward}", "one number", numbers.shape[1])
        step = np.searchsorted(times, tables[reward].times, side="left") - 1
        np.add.at(rewards, step[step >= 0], numbers[step >= 0, 0])
    else:
        notes.append("rewards: 0, because there is no topic " + layout.REWARD)
    actions = action.rows[first:]
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
        tables=tables,
        observed=observed_topics,
        action=action_topic,
        notes=notes,
    )
