"""The names in a LeRobotDataset, version 3.0: a folder of Parquet files and meta/info.json."""

from __future__ import annotations

VERSION = "v3.0"
INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
# What LeRobot has no field for: action space, final observations, seeds. LeRobot ignores the file.
EXTENSION = "meta/spikeserve.json"
EXTENSION_FORMAT = "spikeserve.lerobot.v1"

DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
FILES_PER_CHUNK = 1000
DATA_FILE_MEGABYTES = 100

OBSERVATION = "observation.state"
ACTION = "action"
REWARD = "next.reward"
DONE = "next.done"
TRUNCATED = "next.truncated"
RETURN_TO_GO = "return_to_go"
SPIKES = "spikes"
INTERVENTION = "intervention"

# The columns of every dataset, one number each.
INDICES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
