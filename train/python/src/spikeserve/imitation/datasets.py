"""Reads and writes datasets of Minari."""

from __future__ import annotations

import importlib.util
import pathlib
import shutil
from collections.abc import Iterator, Sequence
from typing import Any

import minari
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import ENV_ID_RE, EnvSpec
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.conversion.child import GROWTH, LEAST_BYTES
from spikeserve.flat_spaces import ActionMap, FlatEnvironment, ObservationMap, element_names
from spikeserve.imitation.episodes import Episode


def check_packages() -> None:
    """ValueError if a package that Minari imports only when it writes or reads is missing."""
    for package in ("h5py", "PIL"):
        found = importlib.util.find_spec(package) is not None
        check(found, package, "the package, which spikeserve-train[imitation] installs", None)


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
    storage = write_storage(partial, episodes, environment.action_space, name, folder.name)
    if names := element_names(environment.native_space):  # the policy file gets them
        recipe = {"minari": folder.name, "observation_names": list(names)}
        storage.update_metadata({"spikeserve": {"environment": name, "recipe": recipe}})
    partial.rename(folder)


def write_storage(
    folder: pathlib.Path,
    episodes: Sequence[Any],
    action_space: spaces.Space[Any],
    name: str,
    dataset_id: str,
    infos: Sequence[dict[str, Any]] | None = None,
) -> MinariStorage:
    """Writes the files of a dataset to `folder` and returns them. `infos` are further infos.

    An episode is one of `imitate` or of a conversion, which have the same fields.
    """
    (folder / "data").mkdir()
    storage = MinariStorage.new(
        folder / "data",
        observation_space=_space_of(episodes[0].observations[0]),
        action_space=action_space,
        env_spec=EnvSpec(name) if ENV_ID_RE.fullmatch(name) else None,
    )
    further = [{} for _ in episodes] if infos is None else infos
    buffers = zip(episodes, further, strict=True)
    storage.update_episodes([_buffer(i, *buffer) for i, buffer in enumerate(buffers)])
    storage.update_metadata({"dataset_id": dataset_id, "minari_version": minari.__version__})
    return storage


def _space_of(observation: NDArray[Any]) -> spaces.Box:
    low, high = (0, 255) if observation.dtype == np.uint8 else (-np.inf, np.inf)
    return spaces.Box(low, high, observation.shape, observation.dtype.type)


def _buffer(index: int, episode: Any, further: dict[str, Any]) -> EpisodeBuffer:
    last = episode.steps - 1
    ended_early = episode.truncated or not episode.terminated
    infos = dict(further)
    # Infos belong to observations, of which there is one more than actions.
    if episode.labels is not None and len(episode.labels):
        infos["label"] = [*episode.labels, episode.labels[-1]]
    if episode.weights is not None and len(episode.weights):
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
    """Opens a dataset, an id or a folder. ValueError if there is none."""
    folder = pathlib.Path(source) / "data"
    is_folder = (folder / "metadata.json").is_file()
    try:
        dataset = minari.MinariDataset(folder) if is_folder else minari.load_dataset(str(source))
    except FileNotFoundError as error:
        expected = "a dataset of Minari, an id on this machine or a folder"
        raise ValueError(f"{source}: expected {expected}, received none") from error
    _check_storage(pathlib.Path(dataset.storage.data_path) / "main_data.hdf5")
    return dataset


def _check_storage(path: pathlib.Path) -> None:
    """ValueError if an HDF5 file is not what it seems.

    It may show other files as its own, a group within itself, or an array that is far larger than
    the file.
    """
    import h5py

    largest = LEAST_BYTES + GROWTH * path.stat().st_size if path.is_file() else 0

    # The library calls these, so they return what is wrong instead of raising it.
    def of_link(name: str, link: Any) -> tuple[str, str] | None:
        return None if isinstance(link, h5py.HardLink) else (name, type(link).__name__)

    def of_object(name: str, item: Any) -> tuple[str, str] | None:
        if not isinstance(item, h5py.Dataset):
            shared = h5py.h5o.get_info(item.id).rc > 1
            return (name, "a group that has two names") if shared else None
        if item.size * item.dtype.itemsize > largest:
            return name, f"more than {largest >> 20} MiB"
        outer = "external storage" if item.external else "a virtual dataset"
        return (name, outer) if item.external or item.is_virtual else None

    if path.is_file():
        with h5py.File(path) as file:
            wrong = of_object("/", file) or file.visititems_links(of_link)
            wrong = wrong or file.visititems(of_object)
        if wrong is not None:
            check(False, f"{path}: {wrong[0]}", "numbers in this file", wrong[1])


def read_dataset(
    source: str | pathlib.Path, environment: FlatEnvironment | None = None
) -> Iterator[Episode]:
    """Reads the episodes of a dataset, an id or a folder, and maps them to the spaces of a policy.

    With `environment` the entries of a Dict have its order. ValueError if the spaces cannot be
    mapped or differ from those of `environment`, or if an episode ends before its last step.
    """
    dataset = open_dataset(source)
    space = dataset.observation_space
    if environment is not None:
        space = check_spaces(dataset, environment, str(source))
    observations = ObservationMap(space)
    actions = ActionMap(dataset.action_space)
    for index, stored in enumerate(dataset.iterate_episodes()):
        steps = len(stored.rewards)
        infos = stored.infos or {}
        for name in ("terminations", "truncations"):
            where = f"{source}: episode {index}: {name}"
            _check_ends(np.asarray(getattr(stored, name)), steps, where)
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


def _check_ends(flags: NDArray[Any], steps: int, where: str) -> None:
    check(flags.shape == (steps,), where, f"shape {(steps,)}", flags.shape)
    for step in np.flatnonzero(flags[:-1])[:1]:
        check(False, f"{where}: step {step}", "true only at the last step", "true")


def check_spaces(
    dataset: minari.MinariDataset, environment: FlatEnvironment, source: str
) -> spaces.Space[Any]:
    """ValueError, which names the part, if a dataset has other spaces than an environment.

    Returns the observation space in whose order the dataset is read. Datasets in the spaces of a
    policy, as `write_dataset` writes them, fit every environment of their size.
    """
    actions, expected = ActionMap(dataset.action_space).space, environment.action_space
    if isinstance(actions, spaces.Box) and isinstance(expected, spaces.Box):
        same = actions.shape == expected.shape and all(
            np.allclose(one, other, 1e-6, 1e-6)
            for one, other in ((actions.low, expected.low), (actions.high, expected.high))
        )
    else:
        same = actions == expected
    as_the_environment = f"{environment.env.action_space}, as the environment has"
    check(same, f"{source}: action_space", as_the_environment, dataset.action_space)
    stored, native = dataset.observation_space, environment.native_space
    if isinstance(stored, spaces.Box) and stored.shape == (environment.observations.size,):
        return stored
    if isinstance(stored, spaces.Dict) and not isinstance(native, spaces.Dict):
        native = _flattened(environment) or native
    _check_same(stored, native, f"{source}: observation_space")
    return native


def _flattened(environment: FlatEnvironment) -> spaces.Space[Any] | None:
    """Returns the Dict that a wrapper such as FlattenObservation has flattened, if there is one."""
    inner = environment.env
    while hasattr(inner, "env"):
        inner = inner.env
        space, size = inner.observation_space, environment.observations.size
        if isinstance(space, spaces.Dict) and spaces.flatdim(space) == size:
            return space
    return None


def _check_same(stored: spaces.Space[Any], native: spaces.Space[Any], where: str) -> None:
    as_the_environment = f"{native}, as the environment has"
    check(type(stored) is type(native), where, as_the_environment, stored)
    if isinstance(native, spaces.Dict) and isinstance(stored, spaces.Dict):
        names, expected = sorted(map(str, stored)), sorted(map(str, native))
        check(names == expected, where, f"the entries {', '.join(expected)}", ", ".join(names))
        for key, part in native.items():
            _check_same(stored[key], part, f"{where}[{key!r}]")
        return
    if isinstance(native, spaces.Tuple) and isinstance(stored, spaces.Tuple):
        check(len(stored) == len(native), where, as_the_environment, stored)
        for index, part in enumerate(native):
            _check_same(stored[index], part, f"{where}[{index}]")
        return
    same = stored.shape == native.shape and spaces.flatdim(stored) == spaces.flatdim(native)
    check(same, where, as_the_environment, stored)


def _at(observations: Any, step: int) -> Any:
    """Returns one step of arrays that a Dict or Tuple space nests."""
    if isinstance(observations, dict):
        return {key: _at(value, step) for key, value in observations.items()}
    if isinstance(observations, tuple):
        return tuple(_at(value, step) for value in observations)
    return observations[step]
