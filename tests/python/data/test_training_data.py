"""`spiketrain train` refuses data that it cannot learn from: it names the file, the episode, the step and the element."""

import json
import math
import os

import cbor2
import numpy as np
import pytest
import safetensors
from gymnasium import spaces
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from serving import run

SPIKETRAIN = os.environ["SPIKETRAIN_PROGRAM"]
TINY = "--iterations=3 --hidden_size=16 --heads=2 --layers=1 --ticks=2 --context=4 --warmup=1 --batch=4".split()
STEPS = 12
ROUNDED = float(np.nextafter(np.float32(1), np.float32(2)))


def episode(**changes):
    """Returns an episode of an environment that spiketrain does not have, with 3 observations and 2 actions."""
    random = np.random.default_rng(0)
    values = {
        "actor": "x",
        "seed": 1,
        "observations": random.normal(size=(STEPS + 1) * 3).tolist(),
        "actions": random.integers(2, size=STEPS).tolist(),
        "rewards": [1.0] * STEPS,
        "terminated": False,
        "truncated": True,
    }
    for key, change in changes.items():
        values[key] = change(list(values.get(key, [1.0] * STEPS))) if callable(change) else change
    return values


def put(index, value):
    def change(values):
        values[index] = value
        return values

    return change


def write(path, last, clean=7, space=None, environment="Robot-v0", **changes):
    """Writes a dataset whose last episode has faults."""
    others = [episode(**changes) for _ in range(clean)]
    value = {
        "format": "spikeserve.dataset.v1",
        "environment": environment,
        "observation_size": 3,
        "recipe": {},
        "action_space": space or {"n": 2},
        "episodes": [*others, episode(**changes, **last)],
    }
    path.write_bytes(cbor2.dumps(value))
    return path


def train(data, out, *flags):
    return run("spiketrain", "train", f"--data={data}", f"--out={out}", *TINY, *flags, status=None)


FINITE = "expected a finite number"
REFUSED = {
    "nan": ({"observations": put(7, math.nan)}, f"observations: step 2, element 1: {FINITE}, received nan"),
    "infinite": ({"observations": put(7, math.inf)}, f"observations: step 2, element 1: {FINITE}, received inf"),
    "huge": ({"observations": put(7, 3e38)}, f"observations: step 2, element 1: {FINITE} of at most 1e18, received 3e+38"),
    "last": ({"observations": put(-1, math.nan)}, f"observations: step {STEPS}, element 2: {FINITE}, received nan"),
    "reward": ({"rewards": put(3, math.nan)}, f"rewards: step 3: {FINITE}, received nan"),
    "large_reward": ({"rewards": put(3, -1e300)}, f"rewards: step 3: {FINITE} of at most 1e18, received -1e+300"),
    "weight": ({"weights": put(2, math.nan)}, f"weights: step 2: {FINITE}, received nan"),
    "negative": ({"weights": put(2, -0.5)}, "weights: step 2: expected a number of at least 0, received -0.5"),
    "asked": ({"asked_return": math.nan}, f"asked_return: {FINITE}, received nan"),
    "index": ({"actions": put(5, 2)}, "actions: step 5: action: expected an index from 0 to 1, received 2"),
    "label": ({"labels": lambda _: [0] * (STEPS - 1) + [7]}, f"labels: step {STEPS - 1}: action: expected an index"),
    "seed": ({"seed": -1}, "seed: expected"),
}


@pytest.mark.parametrize(("last", "reason"), REFUSED.values(), ids=REFUSED)
def test_numbers_are_refused_by_their_place(last, reason, tmp_path):
    path = write(tmp_path / "data.cbor", last)
    trained = train(path, tmp_path / "out")
    assert trained.returncode == 1
    assert f"{path}: episode 7" in trained.stderr and reason in trained.stderr
    assert not (tmp_path / "out").exists()


def box(value):
    return lambda _: [[0.5 if step != 3 else value] for step in range(STEPS)]


def test_an_action_outside_of_its_bounds_is_shown_in_full(tmp_path):
    space = {"low": [-1.0], "high": [1.0]}
    path = write(tmp_path / "data.cbor", {}, space=space, actions=box(1.00001))
    trained = train(path, tmp_path / "out")
    assert "episode 0: actions: step 3: action[0]: expected -1 to 1, received 1.00001\n" in trained.stderr


def test_an_action_that_rounding_left_outside_is_within(tmp_path):
    space = {"low": [-1.0], "high": [1.0]}
    path = write(tmp_path / "data.cbor", {}, space=space, actions=box(ROUNDED), labels=box(-ROUNDED))
    assert train(path, tmp_path / "out", "--no_baselines").returncode == 0


def test_all_weights_of_zero_are_refused(tmp_path):
    path = write(tmp_path / "data.cbor", {}, weights=[0.0] * STEPS)
    trained = train(path, tmp_path / "out")
    assert trained.returncode == 1
    assert "--data: weights: expected one above 0 in the episodes for training, received only 0" in trained.stderr


@pytest.mark.parametrize("weighted", [[0], [3], [0, 1, 2, 3, 4, 5, 6]], ids=["first", "one", "training"])
def test_statistics_of_no_step_are_none(weighted, tmp_path):
    """Weights of few episodes: of one half of those that are compared, or of none that is held out."""
    path = tmp_path / "data.cbor"
    value = cbor2.loads(write(path, {}).read_bytes())
    for index, each in enumerate(value["episodes"]):
        each["weights"] = [float(index in weighted)] * STEPS
    path.write_bytes(cbor2.dumps(value))
    trained = train(path, tmp_path / "out", "--validation=0.1", "--json")
    assert trained.returncode == 0, trained.stderr
    summary = json.loads(trained.stdout)
    assert "validation_loss" not in summary
    assert summary["baselines"]["policy"]["error"] is None
    printed = train(path, tmp_path / "again", "--validation=0.1")
    assert "  the policy       none\n" in printed.stdout


def test_the_policy_is_there_before_what_only_reports(tmp_path):
    """The comparison with lines and perceptrons cannot be written."""
    path = write(tmp_path / "data.cbor", {})
    (tmp_path / "out/baselines.json/not_empty").mkdir(parents=True)
    trained = train(path, tmp_path / "out")
    assert trained.returncode != 0
    with safetensors.safe_open(tmp_path / "out/policy.safetensors", "np") as file:
        assert json.loads(file.metadata()["training"])["seed"] == 0


ENVIRONMENTS = {
    "observations": ({"n": 2}, "--data: expected observations of 4 numbers, as CartPole-v1 has, received 3"),
}


@pytest.mark.parametrize(("space", "reason"), ENVIRONMENTS.values(), ids=ENVIRONMENTS)
def test_a_data_set_is_compared_with_its_environment_first(space, reason, tmp_path):
    trained = train(write(tmp_path / "data.cbor", {}, space=space, environment="CartPole-v1"), tmp_path / "out")
    assert trained.returncode == 1
    assert reason in trained.stderr
    assert not (tmp_path / "out").exists()


def test_the_actions_of_a_data_set_are_compared_with_its_environment_first(tmp_path):
    space = {"low": [-1.0], "high": [1.0]}
    path = write(tmp_path / "data.cbor", {}, space=space, environment="Pendulum-v1", actions=box(0.0))
    trained = train(path, tmp_path / "out")
    reason = "--data: expected the action space Box from [-2] to [2], as Pendulum-v1 has, received Box from [-1] to [1]"
    assert reason in trained.stderr


def test_datasets_with_other_names_are_refused(tmp_path):
    paths = []
    for names in (["x", "y", "z"], ["y", "x", "z"]):
        paths.append(write(tmp_path / f"{names[0]}.cbor", {}))
        value = cbor2.loads(paths[-1].read_bytes())
        value["recipe"] = {"observation_names": names}
        paths[-1].write_bytes(cbor2.dumps(value))
    trained = train(f"{paths[0]},{paths[1]}", tmp_path / "out")
    assert trained.returncode == 1
    assert 'data: observation_names: expected ["x","y","z"] in all datasets, received ["y","x","z"]' in trained.stderr
    assert train(paths[0], tmp_path / "out", "--no_baselines").returncode == 0


UNUSABLE = {
    "few": ({"recipe": {"observation_names": ["x"]}}, 'recipe.observation_names: expected 3 different names of printable'),
    "equal": ({"recipe": {"observation_names": ["x", "x", "y"]}}, "recipe.observation_names: expected 3 different names"),
    "control": ({"recipe": {"action_names": ["\x1b[2J", "b"]}}, "recipe.action_names: expected 1 or 2 different names"),
    "environment": ({"environment": "\x1b]52;c;aGk=\x07"}, "environment: expected printable characters, received "),
}


@pytest.mark.parametrize(("fields", "reason"), UNUSABLE.values(), ids=UNUSABLE)
def test_names_that_a_policy_cannot_have_are_refused(fields, reason, tmp_path):
    path = write(tmp_path / "data.cbor", {})
    path.write_bytes(cbor2.dumps(cbor2.loads(path.read_bytes()) | fields))
    trained = train(path, tmp_path / "out")
    assert trained.returncode == 1
    assert reason in trained.stderr
    assert "\x1b" not in trained.stderr + trained.stdout


def minari_set(folder, ends=None, data_format="hdf5", **metadata):
    (folder / "data").mkdir(parents=True)
    space = spaces.Box(-1, 1, (3,), np.float32)
    storage = MinariStorage.new(
        folder / "data", observation_space=space, action_space=spaces.Discrete(2), data_format=data_format
    )
    over = [False] * (STEPS - 1) + [True]
    observations, actions = [space.sample() for _ in range(STEPS + 1)], [0, 1] * (STEPS // 2)
    buffers = [
        EpisodeBuffer(i, i, None, observations, actions, [1.0] * STEPS, (ends or over) if i == 2 else over, over)
        for i in range(3)
    ]
    storage.update_episodes(buffers)
    storage.update_metadata({"dataset_id": folder.name} | metadata)
    return folder


def test_an_end_in_the_middle_of_an_episode_is_refused(tmp_path):
    folder = minari_set(tmp_path / "a-v0", ends=[step in (4, STEPS - 1) for step in range(STEPS)])
    reason = "episode_2/terminations: step 4: expected true only at the last step, received true"
    assert f"{folder}: {reason}" in train(folder, tmp_path / "out").stderr


def test_minaris_arrow_files_name_the_command_that_converts_them(tmp_path):
    folder = minari_set(tmp_path / "a-v0", data_format="arrow")
    refused = train(folder, tmp_path / "out").stderr
    assert "data_format: expected hdf5, which `python -m spikeserve convert --to=minari` writes, received" in refused


@pytest.mark.parametrize("arguments", ["{}", '{"limit": Infinity, "start": NaN, "text": "a \\\\" NaN"}'])
def test_the_names_and_arguments_of_an_environment_are_read(arguments, tmp_path):
    spec = '{"id": "InfinityMaze-NaN-v0", "kwargs": ' + arguments.replace('\\\\"', '\\"') + "}"
    folder = minari_set(tmp_path / "a-v0", env_spec=spec)
    printed = train(folder, tmp_path / "out", "--no_baselines")
    assert "InfinityMaze-NaN-v0" in printed.stdout, printed.stderr
