"""Reads and writes datasets of Minari."""

from __future__ import annotations

import importlib.util
import pathlib
import shutil
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium
import minari
import numpy as np
from gymnasium import spaces
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.flat_spaces import ActionMap, FlatEnvironment, ObservationMap
from spikeserve.imitation.episodes import Episode


def check_packages() -> None:
    """ValueError if a package that Minari imports only when it writes or reads is missing."""
    for package in ("h5py", "PIL"):
        found = importlib.util.find_spec(package) is not None
        check(found, package, "the package, which spikeserve[imitation] installs", None)


def write_dataset(
    folder: pathlib.Path, episodes: Sequence[Episode], environment: FlatEnvironment, name: str
) -> None:
    """Writes a dataset in the spaces of a policy. `name` is the environment of the policy.

    The labels are in infos/label and the weights in infos/weight. The folder appears when it is
    complete.
    """
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    write_storage(partial, episodes, environment.action_space, name, folder.name)
    partial.rename(folder)


def write_storage(
    folder: pathlib.Path,
    episodes: Sequence[Episode],
    action_space: spaces.Space[Any],
    name: str,
    dataset_id: str,
    infos: Sequence[dict[str, Any]] | None = None,
) -> MinariStorage:
    """Writes the files of a dataset to `folder` and returns them. `infos` are further infos."""
    (folder / "data").mkdir()
    storage = MinariStorage.new(
        folder / "data",
        observation_space=_space_of(episodes[0].observations[0]),
        action_space=action_space,
        env_spec=gymnasium.envs.registration.EnvSpec(name),
    )
    further = [{} for _ in episodes] if infos is None else infos
    buffers = zip(episodes, further, strict=True)
    storage.update_episodes([_buffer(i, *buffer) for i, buffer in enumerate(buffers)])
    storage.update_metadata({"dataset_id": dataset_id, "minari_version": minari.__version__})
    return storage


def _space_of(observation: NDArray[Any]) -> spaces.Box:
    low, high = (0, 255) if observation.dtype == np.uint8 else (-np.inf, np.inf)
    return spaces.Box(low, high, observation.shape, observation.dtype.type)


def _buffer(index: int, episode: Episode, further: dict[str, Any]) -> EpisodeBuffer:
    last = episode.steps - 1
    ended_early = episode.truncated or not episode.terminated
    infos = dict(further)
    # Infos belong to observations, of which there is one more than actions.
    if episode.labels:
        infos["label"] = [*episode.labels, episode.labels[-1]]
    if episode.weights:
        infos["weight"] = [*episode.weights, episode.weights[-1]]
    return EpisodeBuffer(
        index,
        episode.seed,
        None,
        episode.observations,
        episode.actions,
        episode.rewards,
        [episode.terminated and step == last for step in range(episode.steps)],
        [ended_early and step == last for step in range(episode.steps)],
        infos or None,
    )


def open_dataset(source: str | pathlib.Path) -> minari.MinariDataset:
    """Opens a dataset, an id or a folder."""
    folder = pathlib.Path(source)
    if (folder / "data/metadata.json").is_file():
        return minari.MinariDataset(folder / "data")
    return minari.load_dataset(str(source))


def read_dataset(source: str | pathlib.Path) -> Iterator[Episode]:
    """Reads the episodes of a dataset, an id or a folder, and maps them to the spaces of a policy.

    ValueError if its spaces cannot be mapped.
    """
    dataset = open_dataset(source)
    observations = ObservationMap(dataset.observation_space)
    actions = ActionMap(dataset.action_space)
    for stored in dataset.iterate_episodes():
        steps = len(stored.rewards)
        infos = stored.infos or {}
        yield Episode(
            seed=int(stored.id),
            observations=[
                observations.flatten(_at(stored.observations, t)).astype(observations.stored_dtype)
                for t in range(steps + 1)
            ],
            actions=[actions.to_flat(stored.actions[t]) for t in range(steps)],
            labels=[actions.to_flat(label) for label in infos.get("label", [])[:steps]],
            weights=[float(weight) for weight in infos.get("weight", [])[:steps]],
            rewards=np.asarray(stored.rewards, np.float64).tolist(),
            terminated=bool(stored.terminations[-1]),
            truncated=bool(stored.truncations[-1]),
        )


def _at(observations: Any, step: int) -> Any:
    """Returns one step of arrays that a Dict or Tuple space nests."""
    if isinstance(observations, dict):
        return {key: _at(value, step) for key, value in observations.items()}
    if isinstance(observations, tuple):
        return tuple(_at(value, step) for value in observations)
    return observations[step]
