"""LeRobot's own package opens what `convert` writes, and `convert` reads what it writes. Installs 7 GB."""

import json

import numpy as np
import pytest
import robot_data
from own_environment import python_with, run_in
from spikeserve.conversion import Selection, convert
from spikeserve.conversion.converting import read

LEROBOT = "lerobot==0.4.4"  # later releases need Python 3.12

READ = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
dataset = LeRobotDataset("local/robot", root=sys.argv[1])
frames = [dataset[i] for i in range(len(dataset))]
keys = ("observation.state", "action", "next.reward", "next.done", "episode_index", "timestamp", "spikes",
    "intervention")
window = LeRobotDataset("local/robot", root=sys.argv[1], episodes=[1], delta_timestamps={"action": [0, 1 / dataset.fps]})
print(json.dumps({
    "frames": {key: [frame[key].tolist() for frame in frames] for key in keys},
    "tasks": [frame["task"] for frame in frames],
    "fps": dataset.fps,
    "episodes": dataset.meta.total_episodes,
    "mean": dataset.meta.stats["observation.state"]["mean"].tolist(),
    "window": window[0]["action"].tolist(),
}))
"""

WRITE = """
import sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
features = {
    "observation.state": {"dtype": "float32", "shape": (3,), "names": ["a", "b", "c"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
}
dataset = LeRobotDataset.create("local/robot", fps=25, features=features, root=sys.argv[1], use_videos=False)
for episode in range(2):
    for step in range(4 + episode):
        dataset.add_frame({
            "observation.state": np.array([episode, step, 0.5], np.float32),
            "action": np.array([step, -step], np.float32),
            "next.reward": np.array([step / 2], np.float32),
            "task": f"task {episode}",
        })
    dataset.save_episode()
dataset.finalize()
"""


@pytest.fixture(scope="module")
def python():
    return python_with(LEROBOT)


def test_lerobot_opens_an_export(python, tmp_path):
    random = np.random.default_rng(0)
    episodes = [
        (random.normal(size=(steps + 1, 3)), random.uniform(-1, 1, (steps, 2)).astype(np.float32), [0.5] * steps)
        for steps in (6, 4)
    ]
    robot_data.write_recording(tmp_path / "robot/0.cbor", episodes, {"low": [-1, -1], "high": [1, 1]}, served=True)
    exported = convert(tmp_path / "robot", tmp_path / "set", "lerobot", selection=Selection(fps=20, task="Balance"))
    seen = json.loads(run_in(python, READ, tmp_path / "set"))
    observations = np.concatenate([episode.observations[:-1] for episode in exported.episodes])
    actions = np.concatenate([episode.actions for episode in exported.episodes])
    np.testing.assert_array_equal(np.asarray(seen["frames"]["observation.state"], np.float32), observations)
    np.testing.assert_array_equal(np.asarray(seen["frames"]["action"], np.float32), actions)
    assert seen["frames"]["next.reward"] == [0.5] * 10
    assert seen["frames"]["next.done"] == [False] * 5 + [True] + [False] * 3 + [True]
    assert seen["frames"]["episode_index"] == [0] * 6 + [1] * 4
    assert seen["frames"]["spikes"] == [*range(100, 106), *range(100, 104)]
    assert seen["frames"]["intervention"] == [False, True, *[False] * 5, True, *[False] * 2]
    assert set(seen["tasks"]) == {"Balance"}
    assert (seen["fps"], seen["episodes"]) == (20, 2)
    np.testing.assert_allclose(seen["mean"], observations.mean(axis=0), rtol=1e-5)
    np.testing.assert_array_equal(np.asarray(seen["window"], np.float32), actions[6:8])


def test_a_dataset_of_lerobot_is_read(python, tmp_path):
    run_in(python, WRITE, tmp_path / "set")
    data = read(tmp_path / "set")
    assert (data.fps, data.observation_names, data.action_names) == (25, ("a", "b", "c"), ("x", "y"))
    assert [episode.task for episode in data.episodes] == ["task 0", "task 1"]
    for index, episode in enumerate(data.episodes):
        steps = np.arange(4 + index)
        np.testing.assert_array_equal(episode.observations[:-1, 1], steps)
        np.testing.assert_array_equal(episode.actions, np.stack([steps, -steps], axis=1))
        np.testing.assert_array_equal(episode.rewards, steps / 2)
