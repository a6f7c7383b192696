"""Writes a LeRobotDataset, version 3.0, which LeRobot's tools open."""

from __future__ import annotations

import json
import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.conversion import lerobot_layout as layout
from spikeserve.conversion.data import (
    Episode,
    RobotData,
    fingerprint,
    sources_of,
    space_to_json,
)
from spikeserve.conversion.packages import package
from spikeserve.spaces import Discrete

_DEFAULT_FPS = 30
_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


def write_lerobot(data: RobotData, folder: pathlib.Path) -> None:
    """Writes a dataset to `folder`, which exists and is empty."""
    _Writer(data, folder).write()


class _Writer:
    def __init__(self, data: RobotData, folder: pathlib.Path) -> None:
        self._data = data
        self._folder = folder
        fps = data.fps or _DEFAULT_FPS
        self._fps = int(fps) if float(fps).is_integer() else float(fps)
        self._served = all(episode.served is not None for episode in data.episodes)
        self._features = self._make_features()
        tasks = dict.fromkeys(self._task(episode) for episode in data.episodes)
        self._tasks = {task: index for index, task in enumerate(tasks)}

    def write(self) -> None:
        """Writes the data, in files of about 100 MB, and the metadata."""
        rows: list[dict[str, Any]] = []
        columns: list[dict[str, NDArray[Any]]] = []
        waiting: list[dict[str, NDArray[Any]]] = []
        file, size, first = 0, 0, 0
        for index, episode in enumerate(self._data.episodes):
            values = self._columns(index, first, episode)
            bytes_of_it = sum(array.nbytes for array in values.values())
            if waiting and size + bytes_of_it > layout.DATA_FILE_MEGABYTES << 20:
                self._write_data(file, waiting)
                file, size, waiting = file + 1, 0, []
            waiting.append(values)
            columns.append(values)
            size += bytes_of_it
            rows.append(self._episode_row(index, first, file, episode, values))
            first += episode.steps
        self._write_data(file, waiting)
        self._write_table(layout.EPISODES_PATH.format(chunk_index=0, file_index=0), rows)
        stats = {
            key: _stats(np.concatenate([values[key] for values in columns]))
            for key in self._features
        }
        self._write_json(layout.STATS, stats)
        self._write_tasks()
        self._write_json(layout.INFO, self._info())
        self._write_json(layout.EXTENSION, self._extension())

    def _task(self, episode: Episode) -> str:
        return episode.task or self._data.environment

    def _make_features(self) -> dict[str, dict[str, Any]]:
        data = self._data

        def feature(dtype: str, size: int, names: tuple[str, ...] = ()) -> dict[str, Any]:
            fitting = list(names) if len(names) == size else None  # an index may name its values
            return {"dtype": dtype, "shape": [size], "names": fitting}

        discrete = isinstance(data.action_space, Discrete)
        size = 1 if discrete else int(data.episodes[0].actions.shape[1])
        features = {
            layout.OBSERVATION: feature("float32", data.observation_size, data.observation_names),
            layout.ACTION: feature("int64" if discrete else "float32", size, data.action_names),
            layout.REWARD: feature("float64", 1),
            layout.DONE: feature("bool", 1),
            layout.TRUNCATED: feature("bool", 1),
        }
        if self._served:
            features[layout.RETURN_TO_GO] = feature("float32", 1)
            features[layout.SPIKES] = feature("int64", 1)
            features[layout.INTERVENTION] = feature("bool", 1)
        return features | {name: feature(dtype, 1) for name, dtype in layout.INDICES.items()}

    def _columns(self, index: int, first: int, episode: Episode) -> dict[str, NDArray[Any]]:
        """Returns the columns of one episode, [T, size] each."""
        steps = np.arange(episode.steps)
        last = steps == episode.steps - 1
        columns: dict[str, Any] = {
            layout.OBSERVATION: episode.observations[:-1],
            layout.ACTION: episode.actions,
            layout.REWARD: episode.rewards,
            layout.DONE: last & (episode.terminated or episode.truncated),
            layout.TRUNCATED: last & episode.truncated,
            "timestamp": steps / self._fps,
            "frame_index": steps,
            "episode_index": np.full(episode.steps, index),
            "index": first + steps,
            "task_index": np.full(episode.steps, self._tasks[self._task(episode)]),
        }
        if self._served and episode.served is not None:
            columns[layout.RETURN_TO_GO] = episode.served["returns_to_go"]
            columns[layout.SPIKES] = episode.served["spikes"]
            columns[layout.INTERVENTION] = [
                source.startswith("operator") for source in sources_of(episode)
            ]
        return {
            key: np.asarray(columns[key]).astype(feature["dtype"]).reshape(episode.steps, -1)
            for key, feature in self._features.items()
        }

    def _write_data(self, file: int, episodes: list[dict[str, NDArray[Any]]]) -> None:
        arrow, parquet = package("pyarrow"), package("pyarrow.parquet")
        arrays = {}
        for key in self._features:
            values = np.concatenate([episode[key] for episode in episodes])
            flat = arrow.array(values.ravel())
            size = values.shape[1]
            arrays[key] = (
                flat if size == 1 else arrow.FixedSizeListArray.from_arrays(flat, list_size=size)
            )
        place = divmod(file, layout.FILES_PER_CHUNK)
        path = self._folder / layout.DATA_PATH.format(chunk_index=place[0], file_index=place[1])
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(arrow.table(arrays), path)

    def _episode_row(
        self,
        index: int,
        first: int,
        file: int,
        episode: Episode,
        values: dict[str, NDArray[Any]],
    ) -> dict[str, Any]:
        chunk_index, file_index = divmod(file, layout.FILES_PER_CHUNK)
        row: dict[str, Any] = {
            "episode_index": index,
            "tasks": [self._task(episode)],
            "length": episode.steps,
            "data/chunk_index": chunk_index,
            "data/file_index": file_index,
            "dataset_from_index": first,
            "dataset_to_index": first + episode.steps,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for key, array in values.items():
            row |= {f"stats/{key}/{name}": value for name, value in _stats(array).items()}
        return row

    def _write_table(self, name: str, rows: list[dict[str, Any]]) -> None:
        arrow, parquet = package("pyarrow"), package("pyarrow.parquet")
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(arrow.Table.from_pylist(rows), path)

    def _write_tasks(self) -> None:
        """Writes the tasks as pandas does, with the text as the index of the rows."""
        arrow, parquet = package("pyarrow"), package("pyarrow.parquet")
        table = arrow.table({"task_index": list(self._tasks.values()), "task": list(self._tasks)})
        described = {
            "index_columns": ["task"],
            "column_indexes": [],
            "columns": [
                {
                    "name": name,
                    "field_name": name,
                    "pandas_type": pandas_type,
                    "numpy_type": numpy_type,
                    "metadata": None,
                }
                for name, pandas_type, numpy_type in (
                    ("task_index", "int64", "int64"),
                    ("task", "unicode", "object"),
                )
            ],
            "pandas_version": "2.0.0",
        }
        table = table.replace_schema_metadata({"pandas": json.dumps(described)})
        parquet.write_table(table, self._folder / layout.TASKS)

    def _info(self) -> dict[str, Any]:
        episodes = len(self._data.episodes)
        return {
            "codebase_version": layout.VERSION,
            "robot_type": self._data.environment,
            "total_episodes": episodes,
            "total_frames": self._data.steps,
            "total_tasks": len(self._tasks),
            "chunks_size": layout.FILES_PER_CHUNK,
            "data_files_size_in_mb": layout.DATA_FILE_MEGABYTES,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {"train": f"0:{episodes}"},
            "data_path": layout.DATA_PATH,
            "video_path": None,
            "features": self._features,
        }

    def _extension(self) -> dict[str, Any]:
        return {
            "format": layout.EXTENSION_FORMAT,
            "environment": self._data.environment,
            "action_space": space_to_json(self._data.action_space),
            "episodes": [
                {
                    "episode_index": index,
                    "steps": episode.steps,
                    "fingerprint": fingerprint(episode),
                    "seed": episode.seed,
                    "actor": episode.actor,
                    "terminated": episode.terminated,
                    "truncated": episode.truncated,
                    "last_observation": episode.observations[-1].tolist()
                    if episode.has_last_observation
                    else None,
                }
                for index, episode in enumerate(self._data.episodes)
            ],
        }

    def _write_json(self, name: str, value: dict[str, Any]) -> None:
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(value, indent=4, allow_nan=False) + "\n", "utf-8")


def _stats(values: NDArray[Any]) -> dict[str, list[Any]]:
    """Returns LeRobot's statistics of [frames, size]."""
    numbers = values.astype(np.float64)
    stats = {
        "min": values.min(axis=0).tolist(),
        "max": values.max(axis=0).tolist(),
        "mean": numbers.mean(axis=0).tolist(),
        "std": numbers.std(axis=0).tolist(),
        "count": [len(values)],
    }
    quantiles = np.quantile(numbers, list(_QUANTILES.values()), axis=0)
    return stats | {name: q.tolist() for name, q in zip(_QUANTILES, quantiles, strict=True)}
