"""Reads a LeRobotDataset, version 3."""

from __future__ import annotations

import contextlib
import json
import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.conversion import lerobot_layout as layout
from spikeserve.conversion.data import (
    LARGEST_OBSERVATION,
    Episode,
    RobotData,
    Selection,
    action_space_of,
    check_episode,
    environment_name,
    fingerprint,
    space_from_json,
)
from spikeserve.conversion.packages import package

_NUMBERS = {"float16", "float32", "float64", "bool"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}


def read_lerobot(folder: pathlib.Path, selection: Selection) -> RobotData:
    """Reads all episodes of a dataset. A frame is a step: its observation, and its action.

    The observation after the last action is not in the format, and is NaN unless the dataset is an
    export of this package. Rewards are 0 if no column has them.
    """
    info = _read_json(folder / layout.INFO)
    _check_info(folder / layout.INFO, info)
    return _Reader(folder, info, selection).read()


def _read_json(path: pathlib.Path) -> Any:
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: expected a JSON file, received {error}") from error


@contextlib.contextmanager
def _reading(path: pathlib.Path) -> Iterator[None]:
    """Turns an error of pyarrow into a ValueError."""
    try:
        yield
    except MemoryError:
        raise
    except (OSError, package("pyarrow").ArrowException) as error:
        expected = "a Parquet file, received damaged data"
        raise ValueError(f"{path}: expected {expected}: {error}") from error


def _check_info(path: pathlib.Path, info: Any) -> None:
    check(isinstance(info, dict), str(path), "an object", type(info).__name__)
    version = info.get("codebase_version")
    converter = "lerobot.datasets.v30.convert_dataset_v21_to_v30 converts older ones"
    is_v3 = isinstance(version, str) and version.startswith("v3.")
    check(is_v3, f"{path}: codebase_version", f"v3.x ({converter})", version)
    features = info.get("features")
    is_object = isinstance(features, dict) and all(isinstance(f, dict) for f in features.values())
    check(is_object, f"{path}: features", "an object of objects", features)
    for key in ("total_episodes", "total_frames"):
        check(type(info.get(key)) is int, f"{path}: {key}", "an integer", info.get(key))
    fps = info.get("fps")
    check(type(fps) in (int, float), f"{path}: fps", "a number", fps)


class _Reader:
    def __init__(self, folder: pathlib.Path, info: dict[str, Any], selection: Selection) -> None:
        self._folder = folder
        self._info = info
        self._features: dict[str, dict[str, Any]] = info["features"]
        self._selection = selection
        self._notes: list[str] = []
        self._extension = self._read_extension()
        self._observations = self._observation_columns()
        self._action = selection.action or layout.ACTION
        self._size_of(self._action)
        reward = selection.reward or layout.REWARD
        self._reward = reward if selection.reward or reward in self._features else None
        if self._reward is None:
            self._notes.append(f"rewards: 0, because there is no column {layout.REWARD}")
        else:
            self._size_of(self._reward, 1)
        self._ends = [c for c in (layout.DONE, layout.TRUNCATED) if c in self._features]

    def read(self) -> RobotData:
        """Reads the episodes."""
        tables = self._read_tables()
        episodes = _split(tables["episode_index"][:, 0])
        name = f"{self._folder}: column {self._action}"
        actions = [tables[self._action][rows] for rows in episodes]
        if self._extension is not None and not self._selection.has_bounds:
            space = space_from_json(
                self._extension.get("action_space"),
                f"{self._folder / layout.EXTENSION}: action_space",
            )
            discrete = hasattr(space, "n")
            actions = [a[:, 0].astype(np.int64) if discrete else a for a in actions]
        else:
            space, actions, notes = action_space_of(actions, self._selection, name)
            self._notes += notes
        tasks = self._read_tasks() if "task_index" in tables else {}
        data = RobotData(
            environment_name(self._selection, self._environment()),
            space,
            [],
            self._info["fps"] if self._selection.fps is None else self._selection.fps,
            self._names(self._observations),
            self._names([self._action]),
            self._notes,
        )
        for index, (rows, action) in enumerate(zip(episodes, actions, strict=True)):
            episode = self._episode(index, tables, rows, action)
            episode.task = self._selection.task or tasks.get(episode.task, "")
            data.episodes.append(episode)
            check_episode(data, episode, f"{self._folder}: episode {index}")
        return data

    def _environment(self) -> str:
        if self._extension is not None:
            return str(self._extension.get("environment"))
        return self._folder.resolve().name

    def _read_extension(self) -> dict[str, Any] | None:
        """Returns what an export of this package adds, if it is about the selected columns."""
        selected = self._selection
        path = self._folder / layout.EXTENSION
        chosen = selected.observation or selected.action or selected.actions is not None
        if chosen or not path.is_file():
            return None
        value = _read_json(path)
        known = isinstance(value, dict) and value.get("format") == layout.EXTENSION_FORMAT
        check(known, f"{path}: format", layout.EXTENSION_FORMAT, value)
        episodes = value.get("episodes")
        count = self._info["total_episodes"]
        complete = isinstance(episodes, list) and len(episodes) == count
        received = len(episodes) if isinstance(episodes, list) else episodes
        check(complete, f"{path}: episodes", f"{count}, as in {layout.INFO}", received)
        assert isinstance(episodes, list)
        return dict(value) | {"episodes": _by_index(episodes, f"{path}: episodes")}

    def _observation_columns(self) -> list[str]:
        if self._selection.observation:
            columns = list(self._selection.observation)
        else:
            all_of_them = [key for key in self._features if key.startswith("observation.")]
            columns = [key for key in all_of_them if str(self._dtype(key)) in _NUMBERS]
            left_out = [key for key in all_of_them if key not in columns]
            if left_out:
                self._notes.append(f"left out: {', '.join(left_out)}, which are not numbers")
        expected = "a column observation.* of numbers, or --observation"
        check(bool(columns), f"{self._folder / layout.INFO}: features", expected, "none")
        size = sum(self._size_of(column) for column in columns)
        fits = size <= LARGEST_OBSERVATION
        expected = f"at most {LARGEST_OBSERVATION} numbers"
        check(fits, f"{self._folder}: observation", expected, size)
        return columns

    def _dtype(self, column: str) -> Any:
        return self._features[column].get("dtype")

    def _size_of(self, column: str, expected: int | None = None) -> int:
        """Returns the numbers of a column in a frame. ValueError unless it has numbers."""
        where = f"{self._folder / layout.INFO}: features.{column}"
        known = ", ".join(self._features)
        check(column in self._features, where, f"one of {known}", "none")
        dtype = self._dtype(column)
        numbers = isinstance(dtype, str) and dtype in _NUMBERS
        check(numbers, f"{where}.dtype", "numbers", dtype)
        shape = self._features[column].get("shape")
        valid = isinstance(shape, list) and all(type(n) is int and n >= 1 for n in shape)
        check(valid, f"{where}.shape", "a list of positive integers", shape)
        assert isinstance(shape, list)
        size = int(np.prod(shape, dtype=object))
        check(expected in (None, size), f"{where}.shape", f"{expected} number a frame", shape)
        return size

    def _names(self, columns: list[str]) -> tuple[str, ...]:
        """Returns the names of the elements of `columns`, or () unless all of them have names."""
        names: list[str] = []
        for column in columns:
            stored, size = self._features[column].get("names"), self._size_of(column)
            of_column = _names_of(stored, size)
            if of_column is None:
                if stored:
                    self._notes.append(f"left out: the names of {column}, which are not {size}")
                return ()
            names += of_column
        if len(set(names)) < len(names):  # such as the joints of two columns
            sizes = [(column, self._size_of(column)) for column in columns]
            owners = [column for column, size in sizes for _ in range(size)]
            names = [f"{owner}.{name}" for owner, name in zip(owners, names, strict=True)]
        if len(set(names)) < len(names):
            self._notes.append(
                f"left out: the names of {', '.join(columns)}, of which two are equal"
            )
            return ()
        return tuple(names)

    def _read_tables(self) -> dict[str, NDArray[Any]]:
        """Returns the columns of all files, [frames, size] each."""
        paths = sorted((self._folder / "data").glob("*/*.parquet"))
        check(bool(paths), str(self._folder / "data"), "Parquet files", "none")
        wanted = [*self._observations, self._action, "episode_index", "frame_index", *self._ends]
        wanted += [self._reward] if self._reward else []
        wanted += ["task_index"] if "task_index" in self._features else []
        for column in wanted:
            self._size_of(column)
        parts = [self._read_file(path, wanted) for path in paths]
        tables = {column: np.concatenate([part[column] for part in parts]) for column in wanted}
        self._check_frames(tables)
        return tables

    def _read_file(self, path: pathlib.Path, wanted: list[str]) -> dict[str, NDArray[Any]]:
        with _reading(path), package("pyarrow.parquet").ParquetFile(path) as file:
            stored = set(file.schema_arrow.names)
            for column in wanted:
                check(column in stored, f"{path}: {column}", "a column", "none")
            table = file.read(columns=wanted)
            table.validate(full=True)
        return {
            column: _numbers(table.column(column), self._size_of(column), f"{path}: {column}")
            for column in wanted
        }

    def _check_frames(self, tables: dict[str, NDArray[Any]]) -> None:
        info, frames = self._folder / layout.INFO, len(tables["episode_index"])
        expected = self._info["total_frames"]
        in_data = f"{expected} frames in data/, as in {info}"
        check(frames == expected and frames > 0, str(self._folder), in_data, frames)
        episode, frame = tables["episode_index"][:, 0], tables["frame_index"][:, 0]
        change = np.diff(episode)
        starts = np.flatnonzero(np.r_[True, change != 0])
        counted = np.arange(frames) - np.repeat(starts, np.diff(np.r_[starts, frames]))
        wrong = np.flatnonzero(frame != counted)
        if len(wrong):
            where = f"{self._folder}: frame_index of frame {wrong[0]}"
            check(False, where, f"{counted[wrong[0]]}", frame[wrong[0]])
        in_order = episode[0] == 0 and bool(np.all((change == 0) | (change == 1)))
        where = f"{self._folder}: episode_index"
        check(in_order, where, "0, 1, 2 ... in the order of the files", "another order")
        count = int(episode[-1]) + 1
        expected = self._info["total_episodes"]
        check(count == expected, where, f"{expected} episodes, as in {info}", count)

    def _read_tasks(self) -> dict[str, str]:
        """Returns the tasks by their index, as a text."""
        path = self._folder / layout.TASKS
        if not path.is_file():
            return {}
        with _reading(path):
            rows = package("pyarrow.parquet").read_table(path).to_pydict()
        texts = rows.get("task") or rows.get("__index_level_0__") or []
        indices = rows.get("task_index", [])
        same = len(indices) == len(texts)
        check(same, str(path), "the columns task_index and task", list(rows))
        return {str(i): str(text) for i, text in zip(indices, texts, strict=True)}

    def _episode(
        self, index: int, tables: dict[str, NDArray[Any]], rows: slice, actions: NDArray[Any]
    ) -> Episode:
        steps = len(actions)
        parts = [tables[column][rows].astype(np.float32) for column in self._observations]
        observations = np.concatenate(parts, axis=1)
        unknown = np.full((1, observations.shape[1]), np.nan, np.float32)
        reward = tables[self._reward][rows, 0] if self._reward else np.zeros(steps)
        where = f"{self._folder}: episode {index}"
        ends = {c: _ended(tables[c][rows, 0], f"{where}: {c}") for c in self._ends}
        truncated = ends.get(layout.TRUNCATED, not ends.get(layout.DONE, False))
        episode = Episode(
            observations=np.concatenate([observations, unknown]),
            actions=actions,
            rewards=reward.astype(np.float64),
            terminated=ends.get(layout.DONE, False) and not truncated,
            truncated=truncated,
        )
        if "task_index" in tables:
            episode.task = str(int(tables["task_index"][rows][0, 0]))
        if self._extension is not None:
            self._extend(episode, index)
        return episode

    def _extend(self, episode: Episode, index: int) -> None:
        where = f"{self._folder / layout.EXTENSION}: episodes[{index}]"
        assert self._extension is not None
        value = self._extension["episodes"][index]
        steps = value.get("steps", episode.steps)  # absent in older exports
        check(steps == episode.steps, f"{where}.steps", f"{episode.steps}, as in the data", steps)
        stored, received = fingerprint(episode), value.get("fingerprint")
        check(
            received in (None, stored), f"{where}.fingerprint", f"{stored}, of the data", received
        )
        last = value.get("last_observation")
        if last is not None:
            size = episode.observations.shape[1]
            numbers = isinstance(last, list) and all(isinstance(x, int | float) for x in last)
            expected = f"{size} numbers"
            check(numbers and len(last) == size, f"{where}.last_observation", expected, last)
            episode.observations[-1] = last
        for key, kind in (("seed", int), ("actor", str), ("terminated", bool), ("truncated", bool)):
            check(type(value.get(key)) is kind, f"{where}.{key}", kind.__name__, value.get(key))
            setattr(episode, key, value[key])


def _names_of(stored: Any, size: int) -> list[str] | None:
    """Returns names such as ["x", "y"], {"motors": ["x", "y"]} or {"x": 0, "y": 1}."""
    if isinstance(stored, dict) and sorted(map(str, stored.values())) == sorted(
        map(str, range(size))
    ):
        return [str(name) for name in sorted(stored, key=lambda name: int(stored[name]))]
    if isinstance(stored, dict):  # {"motors": [...]}, or {"left": [...], "right": [...]}
        lists = [names for names in stored.values() if isinstance(names, list)]
        joined = [name for names in lists for name in names]
        stored = next((names for names in lists if len(names) == size), joined)
    if not isinstance(stored, list) or len(stored) != size:
        return None
    return [str(name) for name in stored]


def _by_index(episodes: list[Any], where: str) -> list[dict[str, Any]]:
    """Returns the entries of episodes 0, 1, 2 ... Older exports have them in this order."""
    ordered: dict[int, dict[str, Any]] = {}
    for place, value in enumerate(episodes):
        check(isinstance(value, dict), f"{where}[{place}]", "an object", value)
        index = value.get("episode_index", place)
        valid = type(index) is int and 0 <= index < len(episodes) and index not in ordered
        expected = f"each of 0 to {len(episodes) - 1} once"
        check(valid, f"{where}[{place}].episode_index", expected, index)
        ordered[index] = value
    return [ordered[index] for index in range(len(episodes))]


def _ended(flags: NDArray[Any], where: str) -> bool:
    """Returns whether the last frame has the flag. ValueError if an earlier one has it."""
    early = np.flatnonzero(flags[:-1])
    if len(early):
        check(False, f"{where}: step {early[0]}", "true only at the last step", "true")
    return bool(flags[-1])


def _split(episode_index: NDArray[Any]) -> list[slice]:
    """Returns the rows of each episode."""
    starts = np.flatnonzero(np.r_[True, np.diff(episode_index) != 0]).tolist()
    ends = [*starts[1:], len(episode_index)]
    return [slice(start, end) for start, end in zip(starts, ends, strict=True)]


def _numbers(column: Any, size: int, where: str) -> NDArray[Any]:
    """Returns a column as [frames, size]. ValueError unless every frame has `size` numbers."""
    arrow = package("pyarrow")
    compute = package("pyarrow.compute")
    values = column.combine_chunks()
    frames = len(values)
    if isinstance(values, arrow.ExtensionArray):  # of Hugging Face's datasets
        values = values.storage
    while arrow.types.is_nested(values.type):
        is_list = (
            arrow.types.is_list(values.type)
            or arrow.types.is_large_list(values.type)
            or arrow.types.is_fixed_size_list(values.type)
        )
        check(is_list and values.null_count == 0, where, "lists of numbers", values.type)
        lengths = compute.list_value_length(values).to_numpy(zero_copy_only=False)
        equal = len(lengths) == 0 or bool(np.all(lengths == lengths[0]))
        check(equal, where, f"{size} numbers in every frame", "lists of several lengths")
        values = values.flatten()
    numeric = (
        arrow.types.is_integer(values.type)
        or arrow.types.is_floating(values.type)
        or arrow.types.is_boolean(values.type)
    )
    check(numeric, where, "numbers", values.type)
    check(values.null_count == 0, where, "a number in every frame", f"{values.null_count} nulls")
    numbers = np.asarray(values.to_numpy(zero_copy_only=False))
    expected = f"{frames} frames of {size} numbers"
    check(len(numbers) == frames * size, where, expected, f"{len(numbers)} numbers")
    return numbers.reshape(frames, size)
