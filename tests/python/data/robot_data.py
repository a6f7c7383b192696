"""Makes robots' data for tests, as other programs write it."""

import json

import cbor2
import numpy as np
import pyarrow as pa
from mcap.writer import Writer
from pyarrow import parquet

STEPS = (5, 3)  # of the episodes
JOINTS = ["shoulder", "elbow"]


def command(step):
    """Returns the action of a robot at a step of any episode."""
    return np.array([np.sin(step), np.cos(step) * 2], np.float32)


def state(episode, step):
    """Returns the observation of a robot."""
    return np.array([episode, step, step / 7], np.float32)


def write_lerobot(folder):
    """Writes a LeRobotDataset 3.0 of two episodes in two files, with a camera, as a robot records it."""
    features = {
        "action": {"dtype": "float32", "shape": [2], "names": {"motors": JOINTS}},
        "observation.state": {"dtype": "float32", "shape": [2], "names": ["episode", "step"]},
        "observation.extra": {"dtype": "float64", "shape": [1], "names": None},
        "observation.images.top": {"dtype": "video", "shape": [48, 64, 3], "names": ["height", "width", "channels"]},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        **{
            name: {"dtype": "int64", "shape": [1], "names": None}
            for name in ("frame_index", "episode_index", "index", "task_index")
        },
    }
    (folder / "meta").mkdir(parents=True)
    info = {
        "codebase_version": "v3.0",
        "robot_type": "so100",
        "total_episodes": len(STEPS),
        "total_frames": sum(STEPS),
        "total_tasks": 1,
        "chunks_size": 1000,
        "fps": 30,
        "splits": {"train": f"0:{len(STEPS)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "features": features,
    }
    (folder / "meta/info.json").write_text(json.dumps(info))
    parquet.write_table(
        pa.table({"task_index": [0], "__index_level_0__": ["Fold the towel"]}), folder / "meta/tasks.parquet"
    )
    first = 0
    for episode, steps in enumerate(STEPS):
        table = pa.table(
            {
                "action": [command(step).tolist() for step in range(steps)],
                "observation.state": [state(episode, step)[:2].tolist() for step in range(steps)],
                "observation.extra": [float(state(episode, step)[2]) for step in range(steps)],
                "timestamp": pa.array([step / 30 for step in range(steps)], pa.float32()),
                "frame_index": list(range(steps)),
                "episode_index": [episode] * steps,
                "index": list(range(first, first + steps)),
                "task_index": [0] * steps,
            }
        )
        first += steps
        path = folder / f"data/chunk-000/file-{episode:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(table, path)


def write_log(path, topics, encoding="json", schema_encoding="jsonschema"):
    """Writes an MCAP log of (topic, schema name, schema text, [(seconds, encoded message)])."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, name, schema, messages in topics:
            schema_id = writer.register_schema(name, schema_encoding, schema.encode())
            channel = writer.register_channel(topic, encoding, schema_id)
            for seconds, message in messages:
                time = round(seconds * 1e9)
                writer.add_message(channel, time, message, time)
        writer.finish()


def write_json_log(path, topics):
    """Writes an MCAP log of {topic: [(seconds, message)]} in JSON."""
    write_log(
        path,
        [
            (topic, topic.strip("/"), "{}", [(seconds, json.dumps(m).encode()) for seconds, m in messages])
            for topic, messages in topics.items()
        ],
    )


def write_recording(path, episodes, action_space, environment="Arm-v0", served=False):
    """Writes a file as a server records it. `episodes` are (observations, actions, rewards)."""
    stored = []
    for index, (observations, actions, rewards) in enumerate(episodes):
        stored.append(
            {
                "actor": "served" if served else "random",
                "seed": 70 + index,
                "observations": np.asarray(observations, np.float32).ravel().tolist(),
                "actions": np.asarray(actions).tolist(),
                "rewards": list(rewards),
                "terminated": index % 2 == 0,
                "truncated": index % 2 == 1,
            }
        )
        if served:
            steps = len(actions)
            stored[-1]["served"] = {
                "policy": "arm",
                "version": 2,
                "episode": index,
                "target_return": 9.0,
                "seed": 70,
                "learning": False,
                "labels": {"robot": "7"},
                "returns_to_go": [9.0 - step for step in range(steps)],
                "probabilities": [],
                "spikes": [100 + step for step in range(steps)],
                "sources": ["policy", "operator:anna", *["safe"] * steps][:steps],
            }
    value = {
        "format": "spikeserve.dataset.v1",
        "environment": environment,
        "observation_size": np.asarray(episodes[0][0]).shape[1],
        "action_space": action_space,
        "recipe": {},
        "episodes": stored,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cbor2.dumps(value))
