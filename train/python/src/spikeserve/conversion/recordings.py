"""Reads recordings of a server, and reads and writes the datasets of `spiketrain`: CBOR files."""

from __future__ import annotations

import json
import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.conversion.data import (
    Episode,
    RobotData,
    Selection,
    check_episode,
    names_to_json,
    read_names,
    space_from_json,
    space_to_json,
)
from spikeserve.conversion.packages import package
from spikeserve.spaces import ActionSpace, Discrete

SUFFIX = ".cbor"
AMENDMENTS = ".amendments"  # of the file beside a recording, a line for each verdict
_FORMAT = "spikeserve.dataset.v1"


def files_of(source: pathlib.Path) -> list[pathlib.Path]:
    """Returns the files of a recording, of a folder of recordings, or the file itself."""
    return [source] if source.is_file() else sorted(source.rglob(f"*{SUFFIX}"))


def read_recordings(source: pathlib.Path, selection: Selection) -> RobotData:
    """Reads all episodes below `source`.

    With `selection.environment` only those of that environment, of which there must be one.
    """
    data: RobotData | None = None
    first = source
    for path in files_of(source):
        read = read_file(path)
        if selection.environment and read.environment != selection.environment:
            continue
        if data is None:
            data, first = read, path
            continue
        same = (read.environment, read.observation_size, read.action_space)
        expected = (data.environment, data.observation_size, data.action_space)
        what = f"environment, observation size and action space {expected} as in {first}"
        check(same == expected, str(path), f"{what}; --env selects an environment", same)
        for key in ("observation_names", "action_names"):
            names, known = getattr(read, key), getattr(data, key) or getattr(read, key)
            fits = names in ((), known)  # a file without names fits all, as in spiketrain
            check(fits, str(path), f"the names {known} as in {first}", names)
            setattr(data, key, known)
        data.episodes += read.episodes
    of_environment = f" of {selection.environment}" if selection.environment else ""
    check(data is not None, str(source), f"recorded episodes{of_environment}", "none")
    assert data is not None
    data.fps = selection.fps
    return data


def read_file(path: pathlib.Path) -> RobotData:
    """Reads one file, with the amendments of its episode."""
    cbor2 = package("cbor2")
    try:
        value = cbor2.loads(path.read_bytes())
    except (cbor2.CBORDecodeError, ValueError, RecursionError) as error:
        expected = f"a dataset of spikeserve in CBOR ({error})"
        raise ValueError(f"{path}: expected {expected}, received other bytes") from error
    field = str(path)
    check(isinstance(value, dict), field, "an object", type(value).__name__)
    received = value.get("format")
    check(received == _FORMAT, f"{field}: format", _FORMAT, received)
    space = space_from_json(value.get("action_space"), f"{field}: action_space")
    size = _member(value, "observation_size", int, field)
    check(size >= 1, f"{field}: observation_size", "at least 1", size)
    stored = _member(value, "episodes", list, field)
    check(len(stored) > 0, f"{field}: episodes", "at least one", "none")
    if path.with_suffix(AMENDMENTS).exists():
        _amend(stored[0], path.with_suffix(AMENDMENTS))
    episodes = [
        _episode(item, size, space, f"{field}: episode {index}")
        for index, item in enumerate(stored)
    ]
    data = RobotData(_member(value, "environment", str, field), space, episodes)
    read_names(data, value.get("recipe"))
    for index, episode in enumerate(episodes):
        check_episode(data, episode, f"{field}: episode {index}")
    return data


def _amend(episode: Any, path: pathlib.Path) -> None:
    """Applies the verdicts of `path`, as core/dataset/amendments.h does."""
    rewards = _member(episode, "rewards", list, str(path))
    served = _member(episode, "served", dict, str(path))
    for line in path.read_text().splitlines():
        amendment = json.loads(line)
        if amendment.keys() & {"rewards", "reward"}:
            amended = amendment.get("rewards", rewards)
            check(len(amended) == len(rewards), str(path), f"{len(rewards)} rewards", len(amended))
            episode["rewards"] = [*amended[:-1], amended[-1] + amendment.get("reward", 0.0)]
            served["received_rewards"] = rewards
        if "success" in amendment:
            served["success"] = amendment["success"]
        if "label" in amendment:
            served["verdict"] = amendment["label"]


def _member(value: Any, key: str, kind: type | tuple[type, ...], field: str) -> Any:
    names = kind.__name__ if isinstance(kind, type) else " or ".join(k.__name__ for k in kind)
    check(isinstance(value, dict), field, "an object", type(value).__name__)
    check(key in value, f"{field}: {key}", names, "none")
    received = type(value[key]).__name__
    exact = isinstance(value[key], kind) and (kind is bool or received != "bool")
    check(exact, f"{field}: {key}", names, received)
    return value[key]


def _array(value: Any, key: str, dtype: Any, field: str) -> NDArray[Any]:
    stored = _member(value, key, list, field)
    whole = np.issubdtype(dtype, np.integer)
    try:
        array = np.asarray(stored)
        numbers = array.dtype.kind in ("iu" if whole else "iuf")
    except ValueError:
        numbers = False
    expected = f"a list of {'integers' if whole else 'numbers'}"
    check(numbers or not stored, f"{field}: {key}", expected, "other values")
    with np.errstate(over="ignore"):  # what is too large becomes an infinity, and is refused
        return array.astype(dtype)


def _episode(value: Any, size: int, space: ActionSpace, field: str) -> Episode:
    dtype = np.int64 if isinstance(space, Discrete) else np.float32
    observations = _array(value, "observations", np.float32, field)
    divisible = observations.ndim == 1 and len(observations) % size == 0
    expected = f"a multiple of {size} numbers"
    check(divisible, f"{field}: observations", expected, observations.shape)
    served = value.get("served")
    if served is not None:
        _member(value, "served", dict, field)
    asked = None
    if "asked_return" in value:
        asked = _member(value, "asked_return", (int, float), field)
    return Episode(
        observations=observations.reshape(-1, size),
        actions=_array(value, "actions", dtype, field),
        rewards=_array(value, "rewards", np.float64, field),
        terminated=_member(value, "terminated", bool, field),
        truncated=_member(value, "truncated", bool, field),
        seed=_member(value, "seed", int, field),
        actor=_member(value, "actor", str, field),
        labels=_array(value, "labels", dtype, field) if "labels" in value else None,
        weights=_array(value, "weights", np.float32, field) if "weights" in value else None,
        asked_return=asked,
        served=served,
    )


def write_cbor(data: RobotData, path: pathlib.Path) -> None:
    """Writes a dataset that `spiketrain train --data=` reads."""
    value = {
        "format": _FORMAT,
        "environment": data.environment,
        "observation_size": data.observation_size,
        "recipe": {"converted": True} | names_to_json(data),
        "action_space": space_to_json(data.action_space),
        "episodes": [_episode_to_cbor(episode) for episode in data.episodes],
    }
    path.write_bytes(package("cbor2").dumps(value))


def _episode_to_cbor(episode: Episode) -> dict[str, Any]:
    value: dict[str, Any] = {
        "actor": episode.actor,
        "seed": episode.seed,
        "observations": episode.observations.ravel().tolist(),
        "actions": episode.actions.tolist(),
        "rewards": episode.rewards.tolist(),
        "terminated": episode.terminated,
        "truncated": episode.truncated,
    }
    if episode.labels is not None:
        value["labels"] = episode.labels.tolist()
    if episode.weights is not None:
        value["weights"] = episode.weights.tolist()
    if episode.asked_return is not None:
        value["asked_return"] = episode.asked_return
    if episode.served is not None:
        value["served"] = dict(episode.served)
    return value
