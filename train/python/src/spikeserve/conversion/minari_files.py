"""Reads and writes datasets of Minari, which `spiketrain` and `imitate` train on."""

from __future__ import annotations

import pathlib
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from spikeserve.check import check
from spikeserve.conversion.data import (
    SOURCES,
    Episode,
    RobotData,
    Selection,
    check_episode,
    names_to_json,
    read_names,
    sources_of,
)
from spikeserve.conversion.packages import package
from spikeserve.spaces import ActionSpace, Discrete, as_action_space

if TYPE_CHECKING:
    from spikeserve.imitation.episodes import Episode as PlayedEpisode

METADATA = "data/metadata.json"
DATA = "data/main_data.hdf5"
_EXTENSION = "spikeserve"  # our key in the metadata


def _check_packages() -> None:
    for name in ("h5py", "minari", "PIL"):
        package(name)


def read_minari(folder: pathlib.Path, selection: Selection) -> RobotData:
    """Reads a dataset of Minari and maps its spaces to those of a policy."""
    _check_packages()
    from spikeserve.flat_spaces import ActionMap, element_names
    from spikeserve.imitation.datasets import open_dataset, read_dataset

    try:
        dataset = open_dataset(folder)
        space = as_action_space(ActionMap(dataset.action_space).space)
        played = list(read_dataset(folder))
        stored = list(dataset.storage.get_episode_metadata(range(len(played))))
        metadata = dataset.storage.metadata
    except (OSError, KeyError, RuntimeError, TypeError, IndexError, AttributeError) as error:
        expected = f"a dataset that Minari reads ({type(error).__name__}: {error})"
        raise ValueError(f"{folder / DATA}: expected {expected}, received other data") from error
    check(len(played) > 0, str(folder / DATA), "at least one episode", "none")
    specified = getattr(dataset.env_spec, "id", None)
    ours = metadata.get(_EXTENSION, {})
    check(isinstance(ours, dict), f"{folder / METADATA}: {_EXTENSION}", "an object", ours)
    name = ours.get("environment") or specified or folder.name
    episodes = [
        _from_played(episode, attributes, space)
        for episode, attributes in zip(played, stored, strict=True)
    ]
    data = RobotData(selection.environment or name, space, episodes, selection.fps)
    data.observation_names = element_names(dataset.observation_space)
    read_names(data, ours.get("recipe"))
    for index, episode in enumerate(episodes):
        check_episode(data, episode, f"{folder / DATA}: episode {index}")
    return data


def _from_played(played: PlayedEpisode, attributes: dict[str, Any], space: ActionSpace) -> Episode:
    dtype = np.int64 if isinstance(space, Discrete) else np.float32
    asked = attributes.get("asked_return")
    return Episode(
        observations=np.asarray(np.stack(played.observations), np.float32),
        actions=np.asarray(played.actions, dtype),
        rewards=np.asarray(played.rewards, np.float64),
        terminated=played.terminated,
        truncated=played.truncated,
        seed=_seed_of(attributes, played.seed),
        actor=str(attributes.get("actor", "unknown")),
        labels=np.asarray(played.labels, dtype) if played.labels else None,
        weights=np.asarray(played.weights, np.float32) if played.weights else None,
        asked_return=None if asked is None else float(asked),
    )


def _seed_of(attributes: dict[str, Any], default: int) -> int:
    """Returns the seed of an episode. Minari stores none, or a text, for some."""
    try:
        return int(attributes.get("seed", default))
    except (TypeError, ValueError):
        return default


def write_minari(data: RobotData, folder: pathlib.Path, dataset_id: str) -> None:
    """Writes a dataset of Minari to `folder`."""
    _check_packages()
    named = re.search(r"-v\d+$", dataset_id) is not None
    check(named, "out", "a folder name that ends in -v and a number, for Minari", dataset_id)
    from gymnasium import spaces

    from spikeserve.imitation.datasets import write_storage

    native: spaces.Space[Any]
    if isinstance(data.action_space, Discrete):
        native = spaces.Discrete(data.action_space.n)
    else:
        low, high = data.action_space.low, data.action_space.high
        native = spaces.Box(np.array(low, np.float32), np.array(high, np.float32))
    storage = write_storage(
        folder,
        data.episodes,
        native,
        data.environment,
        dataset_id,
        [_infos(episode) for episode in data.episodes],
    )
    attributes = [_attributes(episode) for episode in data.episodes]
    storage.update_episode_metadata(attributes, range(len(attributes)))
    extension = {"environment": data.environment, "recipe": names_to_json(data)}
    storage.update_metadata({_EXTENSION: extension})


def _infos(episode: Episode) -> dict[str, Any]:
    """Returns the infos of T + 1 observations, as `spiketrain dataset` writes them."""
    returns = (episode.served or {}).get("returns_to_go")
    if returns is None:
        return {}
    last = returns[-1] - episode.rewards[-1]
    sources = [SOURCES.index(source.partition(":")[0]) for source in sources_of(episode)]
    return {
        "return_to_go": np.asarray([*returns, last], np.float32),
        "source": np.asarray([*sources, sources[-1]], np.int64),
    }


def _attributes(episode: Episode) -> dict[str, Any]:
    attributes: dict[str, Any] = {"actor": episode.actor, "seed": episode.seed}
    if episode.asked_return is not None:
        attributes["asked_return"] = episode.asked_return
    if episode.served is not None:
        attributes["policy"] = episode.served["policy"]
        attributes["policy_version"] = episode.served["version"]
    return attributes
