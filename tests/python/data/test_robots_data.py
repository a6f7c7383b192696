"""`python -m spikeserve convert`: robots' data become training data, and recordings go out."""

import contextlib
import dataclasses
import io
import json
import os
import pathlib
import shutil
import subprocess
import sys
import unittest.mock

import cbor2
import gymnasium
import minari
import numpy as np
import pyarrow as pa
import pytest
import robot_data
import spikeserve
from mcap.reader import make_reader
from pyarrow import parquet
from serving import running_server
from spikeserve.__main__ import main
from spikeserve.conversion import Selection, convert, lerobot_layout
from spikeserve.conversion.converting import read

RANDOM = np.random.default_rng(0)
SPACES = {
    "discrete": {"n": 3},
    "box": {"low": [-1.0, 0.0], "high": [1.0, 4.5]},
}


def random_episode(space, steps, last=True):
    observations = RANDOM.normal(size=(steps + 1, 3)).astype(np.float32)
    if not last:
        observations[-1] = np.nan
    if "n" in space:
        actions = RANDOM.integers(space["n"], size=steps)
    else:
        actions = RANDOM.uniform(space["low"], space["high"], (steps, 2)).astype(np.float32)
    return observations, actions, RANDOM.normal(size=steps).tolist()


def run(*arguments):
    """Runs the command. Returns its output, or raises with its standard error."""
    output, errors = io.StringIO(), io.StringIO()
    with (
        unittest.mock.patch.object(sys, "argv", ["spikeserve", "convert", *map(str, arguments)]),
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(errors),
    ):
        if main() != 0:
            raise ValueError(errors.getvalue())
    assert not errors.getvalue()
    return output.getvalue()


def assert_equal(one, other):
    """Asserts that two RobotData hold the same episodes, bit for bit."""
    assert one.action_space == other.action_space
    for name in ("environment", "observation_names", "action_names"):
        assert getattr(one, name) == getattr(other, name), name
    assert len(one.episodes) == len(other.episodes)
    for mine, theirs in zip(one.episodes, other.episodes, strict=True):
        np.testing.assert_array_equal(mine.observations, theirs.observations)
        np.testing.assert_array_equal(mine.actions, theirs.actions)
        np.testing.assert_array_equal(mine.rewards, theirs.rewards)
        for name in ("seed", "actor", "terminated", "truncated"):
            assert getattr(mine, name) == getattr(theirs, name), name


@pytest.mark.parametrize("form", ["lerobot", "mcap", "minari", "spikeserve"])
@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
def test_every_format_keeps_every_number(form, space, tmp_path):
    episodes = [random_episode(space, 6), random_episode(space, 1, last=False), random_episode(space, 4)]
    robot_data.write_recording(tmp_path / "robot/a/000000.cbor", episodes[:1], space)
    robot_data.write_recording(tmp_path / "robot/b/000000.cbor", episodes[1:], space)
    out = tmp_path / ("there.cbor" if form == "spikeserve" else "there-v0")
    printed = run(tmp_path / "robot", out, "--to", form)
    assert "3 episodes, 11 steps of Arm-v0; observation: 3 numbers, action: " in printed
    assert_equal(read(tmp_path / "robot"), read(out))
    run(out, tmp_path / "back.cbor", "--to=spikeserve")
    assert_equal(read(tmp_path / "robot"), read(tmp_path / "back.cbor"))


def test_lerobot_data_become_training_data(tmp_path):
    robot_data.write_lerobot(tmp_path / "towels")
    printed = run(tmp_path / "towels", tmp_path / "towels-v0", "--to=minari", "--env=So100-v0")
    assert "left out: observation.images.top, which are not numbers" in printed
    assert "rewards: 0, because there is no column next.reward" in printed
    assert "--action-low and --action-high give them" in printed
    dataset = minari.MinariDataset(tmp_path / "towels-v0/data")
    assert dataset.env_spec.id == "So100-v0"
    largest = np.max([robot_data.command(step) for step in range(max(robot_data.STEPS))], axis=0)
    np.testing.assert_array_equal(dataset.action_space.high, largest)
    for index, episode in enumerate(dataset.iterate_episodes()):
        steps = robot_data.STEPS[index]
        expected = [robot_data.state(index, step) for step in range(steps)]
        np.testing.assert_array_equal(episode.observations[:-1], expected)
        assert np.isnan(episode.observations[-1]).all()
        np.testing.assert_array_equal(episode.actions, [robot_data.command(step) for step in range(steps)])
        assert episode.truncations[-1] and not episode.terminations[-1]


def test_columns_bounds_and_names_are_selected(tmp_path):
    robot_data.write_lerobot(tmp_path / "towels")
    selection = Selection(observation=("observation.extra",), action_low=(-5,), action_high=(5, 6), task="Fold")
    data = convert(tmp_path / "towels", tmp_path / "out", "lerobot", selection=selection)
    assert data.action_space.low == (-5, -5)
    assert data.action_space.high == (5, 6)
    assert data.observation_size == 1
    back = read(tmp_path / "out")
    assert back.action_names == tuple(robot_data.JOINTS)
    assert back.fps == 30
    assert {episode.task for episode in back.episodes} == {"Fold"}
    whole = read(tmp_path / "towels")
    assert {episode.task for episode in whole.episodes} == {"Fold the towel"}
    convert(tmp_path / "towels", tmp_path / "logs", "mcap")
    for exported in ("out", "logs"):  # which declare their own bounds
        assert read(tmp_path / exported, selection=Selection(action_high=(9,))).action_space.high == (9, 9)


def test_logs_of_topics_at_several_rates_become_steps(tmp_path):
    """A step is an action: with the last observation before it, and the rewards up to the next one."""
    log = {
        "/joints": [(t / 10, {"stamp": {"sec": 1}, "position": [t, -t]}) for t in range(21)],
        "/battery": [(0.05, {"volts": 11.5}), (1.25, {"volts": 11.0})],
        "/command": [(0.0, {"data": [9.0]}), *[(0.5 * k + 0.01, {"data": [k / 2]}) for k in range(1, 4)]],
        "/score": [(0.9, {"value": 1.0}), (1.0, {"value": 2.0}), (1.2, {"value": 4.0})],
    }
    (tmp_path / "logs").mkdir()
    robot_data.write_json_log(tmp_path / "logs/one.mcap", log)
    arguments = ["--observation=/joints.position,/battery", "--action=/command", "--reward=/score.value"]
    printed = run(tmp_path / "logs", tmp_path / "out.cbor", "--to=spikeserve", *arguments)
    assert "left out 1 actions before the first observation" in printed
    (episode,) = read(tmp_path / "out.cbor").episodes
    np.testing.assert_array_equal(episode.actions[:, 0], [0.5, 1.0, 1.5])
    expected = [[5, -5, 11.5], [10, -10, 11.5], [15, -15, 11.0]]
    np.testing.assert_array_equal(episode.observations[:-1], expected)
    assert np.isnan(episode.observations[-1]).all()  # the battery said nothing afterwards
    np.testing.assert_array_equal(episode.rewards, [3, 4, 0])


def test_logs_of_ros_2_are_read(tmp_path):
    """CDR: a header of 4 bytes, then little-endian values, aligned."""
    schema = "float32[] data"

    def encode(*values):
        return b"\0\1\0\0" + len(values).to_bytes(4, "little") + np.asarray(values, "<f4").tobytes()

    topics = [
        ("/state", "std_msgs/msg/Numbers", schema, [(k, encode(k, k + 0.5)) for k in range(4)]),
        ("/command", "std_msgs/msg/Numbers", schema, [(k + 0.5, encode(-k)) for k in range(3)]),
    ]
    robot_data.write_log(tmp_path / "ros.mcap", topics, "cdr", "ros2msg")
    selection = Selection(observation=("/state.data",), action="/command.data")
    (episode,) = read(tmp_path / "ros.mcap", selection=selection).episodes
    np.testing.assert_array_equal(episode.observations, [[k, k + 0.5] for k in range(4)])
    np.testing.assert_array_equal(episode.actions, [[0], [-1], [-2]])


def test_exported_logs_have_the_decisions_and_schemas(tmp_path):
    episode = random_episode(SPACES["discrete"], 3)
    robot_data.write_recording(tmp_path / "robot/000000.cbor", [episode], SPACES["discrete"], served=True)
    run(tmp_path / "robot", tmp_path / "logs", "--to=mcap", "--fps=20")
    (path,) = (tmp_path / "logs").iterdir()
    with path.open("rb") as file:
        messages = [
            (channel.topic, message.log_time, json.loads(message.data))
            for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages()
            if json.loads(schema.data)["type"] == "object"
        ]
    decisions = [(time, m) for topic, time, m in messages if topic == "/decision"]
    assert decisions == [(50_000_000 * k, {"return_to_go": 9.0 - k, "spikes": 100 + k}) for k in range(3)]
    rewards = [(time, m["value"]) for topic, time, m in messages if topic == "/reward"]
    assert rewards == [(50_000_000 * (k + 1), episode[2][k]) for k in range(3)]


def test_minari_and_lerobot_have_the_decisions_of_the_server(tmp_path):
    episodes = [random_episode(SPACES["box"], 3), random_episode(SPACES["box"], 2)]
    robot_data.write_recording(tmp_path / "robot/000000.cbor", episodes, SPACES["box"], served=True)
    run(tmp_path / "robot", tmp_path / "served-v1", "--to=minari")
    dataset = minari.MinariDataset(tmp_path / "served-v1/data")
    first, _ = dataset.iterate_episodes()
    np.testing.assert_array_equal(first.infos["return_to_go"][:-1], [9, 8, 7])
    attributes = list(dataset.storage.get_episode_metadata([0]))[0]
    assert (attributes["policy"], attributes["policy_version"], attributes["seed"]) == ("arm", 2, 70)
    run(tmp_path / "robot", tmp_path / "set", "--to=lerobot", "--fps=20")
    table = parquet.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")
    assert table["spikes"].to_pylist() == [100, 101, 102, 100, 101]
    assert table["return_to_go"].to_pylist() == [9, 8, 7, 9, 8]
    assert table["next.done"].to_pylist() == [False, False, True, False, True]
    assert table["next.truncated"].to_pylist() == [False] * 4 + [True]
    np.testing.assert_allclose(table["timestamp"].to_pylist(), [0, 0.05, 0.1, 0, 0.05], atol=1e-6)


def test_large_datasets_have_several_files(tmp_path, monkeypatch):
    monkeypatch.setattr(lerobot_layout, "DATA_FILE_MEGABYTES", 0)
    monkeypatch.setattr(lerobot_layout, "FILES_PER_CHUNK", 2)
    episodes = [random_episode(SPACES["box"], 2) for _ in range(3)]
    robot_data.write_recording(tmp_path / "robot/000000.cbor", episodes, SPACES["box"])
    convert(tmp_path / "robot", tmp_path / "set", "lerobot")
    files = sorted(str(path.relative_to(tmp_path / "set/data")) for path in (tmp_path / "set/data").glob("*/*"))
    assert files == ["chunk-000/file-000.parquet", "chunk-000/file-001.parquet", "chunk-001/file-000.parquet"]
    rows = parquet.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet")
    assert rows["data/chunk_index"].to_pylist() == [0, 0, 1]
    assert rows["dataset_from_index"].to_pylist() == [0, 2, 4]
    assert_equal(read(tmp_path / "robot"), read(tmp_path / "set"))


def edit_info(folder, **fields):
    path = folder / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def edit_table(folder, change):
    path = folder / "data/chunk-000/file-001.parquet"
    table = parquet.read_table(path).to_pydict()
    change(table)
    parquet.write_table(pa.table(table), path)


def cut(path):
    path.write_bytes(path.read_bytes()[:-30])


FILE = "data/chunk-000/file-001.parquet"
DAMAGES = {
    "version": (lambda f: edit_info(f, codebase_version="v2.1"), "codebase_version: expected v3.x"),
    "json": (lambda f: (f / "meta/info.json").write_text("{"), "info.json: expected a JSON file"),
    "fps": (lambda f: edit_info(f, fps=0), "towels: fps: expected a number from 1e-06 to 1e+06, received 0"),
    "features": (lambda f: edit_info(f, features=[]), "features: expected an object of objects"),
    "frames": (lambda f: edit_info(f, total_frames=9), "expected 9 frames in data/, as in "),
    "missing": (lambda f: (f / FILE).unlink(), "expected 8 frames in data/, as in "),
    "cut": (lambda f: cut(f / FILE), f"{FILE}: expected a Parquet file, received damaged data"),
    "column": (lambda f: edit_table(f, lambda t: t.pop("action")), f"{FILE}: action: expected a column, received none"),
    "length": (
        lambda f: edit_table(f, lambda t: t["action"].__setitem__(1, [1.0])),
        f"{FILE}: action: expected 2 numbers in every frame, received lists of several lengths",
    ),
    "null": (
        lambda f: edit_table(f, lambda t: t["observation.extra"].__setitem__(1, None)),
        f"{FILE}: observation.extra: expected a number in every frame, received 1 nulls",
    ),
    "text": (
        lambda f: edit_table(f, lambda t: t.__setitem__("observation.extra", ["x"] * 3)),
        f"{FILE}: observation.extra: expected numbers, received string",
    ),
    "nan": (
        lambda f: edit_table(f, lambda t: t["observation.state"].__setitem__(1, [0.0, float("nan")])),
        "episode 1: observations: step 1, element 1: expected a finite number, received nan",
    ),
    "infinite_action": (
        lambda f: edit_table(f, lambda t: t["action"].__setitem__(2, [0.0, float("inf")])),
        "column action: episode 1: step 2, element 1: expected a finite number, received inf",
    ),
    "order": (
        lambda f: edit_table(f, lambda t: t.__setitem__("frame_index", [0, 2, 1])),
        "frame_index of frame 6: expected 1, received 2",
    ),
    "episodes": (
        lambda f: edit_table(f, lambda t: t.__setitem__("episode_index", [2, 2, 2])),
        "episode_index: expected 0, 1, 2 ... in the order of the files",
    ),
}


@pytest.mark.parametrize(("damage", "reason"), DAMAGES.values(), ids=DAMAGES)
def test_damaged_lerobot_data_are_refused_by_name(damage, reason, tmp_path):
    robot_data.write_lerobot(tmp_path / "towels")
    damage(tmp_path / "towels")
    with pytest.raises(ValueError) as refused:
        convert(tmp_path / "towels", tmp_path / "out-v0", "minari")
    assert reason in str(refused.value)
    assert [path.name for path in tmp_path.iterdir()] == ["towels"]


def joints(*values):
    return {"/observation": [(0, {"values": [1.0, 2.0]})], "/action": [(1, {"values": v}) for v in values]}


LOGS = {
    "cut": (joints([1.0]), cut, "log.mcap: expected an MCAP log, received damaged data"),
    "flipped": (joints([1.0]), lambda p: flip(p), "log.mcap: expected an MCAP log, received damaged data"),
    "empty": (joints([1.0]), lambda p: p.write_bytes(b""), "log.mcap: expected an MCAP log"),
    "topic": ({"/imu": [(0, {"x": 1})]}, None, "/observation: expected a topic of the log (/imu)"),
    "silent": (joints(), None, "log.mcap: /action: expected messages, received none"),
    "sizes": (
        joints([1.0, 2.0], [1.0]),
        None,
        "/action: message 1: expected 2 numbers, as in the first message, received 1",
    ),
    "text": (joints("up"), None, "/action: message 0: expected a number or a list of numbers"),
    "early": (
        {"/observation": [(2, {"values": [1.0]})], "/action": [(1, {"values": [1.0]})]},
        None,
        "expected an action after the first message of every observation topic, received none",
    ),
    "same": (
        joints([1.0], [1.0]),
        None,
        "element 0: expected values that differ, or --action-low below --action-high, received bounds 1 and 1",
    ),
}


def flip(path):
    """Changes a byte of the compressed messages."""
    content = bytearray(path.read_bytes())
    at = content.index(b"\x28\xb5\x2f\xfd") + 20  # zstd's magic
    content[at] ^= 0xFF
    path.write_bytes(content)


@pytest.mark.parametrize(("log", "damage", "reason"), LOGS.values(), ids=LOGS)
def test_damaged_logs_are_refused_by_name(log, damage, reason, tmp_path):
    robot_data.write_json_log(tmp_path / "log.mcap", log)
    if damage:
        damage(tmp_path / "log.mcap")
    with pytest.raises(ValueError) as refused:
        convert(tmp_path / "log.mcap", tmp_path / "out.cbor", "spikeserve")
    assert reason in str(refused.value)
    assert [path.name for path in tmp_path.iterdir()] == ["log.mcap"]


SERVED = {"policy": "p", "version": 1, "returns_to_go": [1.0] * 3, "spikes": [1] * 3}


def edited_recording(**fields):
    def edit(path):
        value = cbor2.loads(path.read_bytes())
        value["episodes"][0] |= fields
        path.write_bytes(cbor2.dumps(value))

    return edit


RECORDINGS = {
    "cut": (cut, "000000.cbor: expected a dataset of spikeserve in CBOR"),
    "other": (lambda p: p.write_bytes(cbor2.dumps([1])), "000000.cbor: expected an object, received list"),
    "deep": (lambda p: p.write_bytes(b"\x81" * 100_000), "000000.cbor: expected "),
    "action": (edited_recording(actions=[0, 3, 1]), "actions: step 1: expected an index in [0, 3), received 3"),
    "rewards": (edited_recording(rewards=[1.0]), "episode 0: rewards: expected shape (3,), received (1,)"),
    "columns": (edited_recording(rewards=[[1.0]] * 3), "rewards: expected shape (3,), received (3, 1)"),
    "index": (edited_recording(actions=[0, 1.0, 1]), "actions: expected a list of integers, received other values"),
    "switch": (edited_recording(seed=True), "seed: expected int, received bool"),
    "digits": (edited_recording(asked_return=10**400), "asked_return: expected a finite number, received 1000"),
    "actor": (edited_recording(actor="\x1b[2J"), "actor: expected printable characters"),
    "served": (edited_recording(served={}), "served.policy: expected a value, received none"),
    "returns": (edited_recording(served=SERVED | {"returns_to_go": [1.0]}), "served.returns_to_go: expected a list of 3"),
    "spikes": (edited_recording(served=SERVED | {"spikes": [1, -1, 0]}), "served.spikes: step 1: expected an integer"),
    "observation": (edited_recording(observations=[1.0] * 11), "observations: expected a multiple of 3 numbers"),
    "text": (edited_recording(rewards=["a"] * 3), "rewards: expected a list of numbers, received other values"),
    "seed": (edited_recording(seed="x"), "episode 0: seed: expected int, received str"),
}


@pytest.mark.parametrize(("damage", "reason"), RECORDINGS.values(), ids=RECORDINGS)
def test_damaged_recordings_are_refused_by_name(damage, reason, tmp_path):
    path = tmp_path / "robot/000000.cbor"
    robot_data.write_recording(path, [random_episode(SPACES["discrete"], 3)], SPACES["discrete"])
    damage(path)
    with pytest.raises(ValueError) as refused:
        convert(tmp_path / "robot", tmp_path / "out", "lerobot")
    assert reason in str(refused.value)
    assert [path.name for path in tmp_path.iterdir()] == ["robot"]


def test_damaged_minari_data_are_refused_by_name(tmp_path):
    robot_data.write_recording(tmp_path / "robot/0.cbor", [random_episode(SPACES["box"], 3)], SPACES["box"])
    run(tmp_path / "robot", tmp_path / "set-v0", "--to=minari")
    with (tmp_path / "set-v0/data/main_data.hdf5").open("r+b") as file:
        file.truncate(900)
    with pytest.raises(ValueError, match="main_data.hdf5: expected a dataset that Minari reads"):
        read(tmp_path / "set-v0")


def test_existing_data_are_replaced_only_by_their_like(tmp_path):
    robot_data.write_lerobot(tmp_path / "towels")
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("years of work")
    with pytest.raises(ValueError, match="out: expected a path that does not exist, or --overwrite"):
        convert(tmp_path / "towels", out, "lerobot")
    with pytest.raises(ValueError, match="out: expected data in the format lerobot, which --overwrite replaces"):
        convert(tmp_path / "towels", out, "lerobot", overwrite=True)
    assert (out / "thesis.txt").exists()
    shutil.rmtree(out)
    convert(tmp_path / "towels", out, "lerobot", selection=Selection(fps=10))
    convert(tmp_path / "towels", out, "lerobot", overwrite=True)
    assert read(out).fps == 30


ARGUMENTS = {
    "source": (["nowhere", "out", "--to=mcap"], "source: expected a file or folder, received nowhere"),
    "suffix": (["towels", "out", "--to=spikeserve"], "out: expected a file .cbor for spikeserve, received out"),
    "minari": (["towels", "out", "--to=minari"], "out: expected a folder name that ends in -v and a number"),
    "column": (["towels", "o", "--to=mcap", "--action=arm"], "features.arm: expected one of action, "),
    "video": (
        ["towels", "o", "--to=mcap", "--observation=observation.images.top"],
        "features.observation.images.top.dtype: expected numbers, received video",
    ),
    "no time": (["towels", "o", "--to=mcap", "--fps=0"], "towels: fps: expected a number from 1e-06 to 1e+06, received 0.0"),
    "no actions": (
        ["towels", "o", "--to=mcap", "--action=task_index", "--actions=0"],
        "column task_index: expected 2 to 4096 discrete actions, received 0",
    ),
    "bounds": (["towels", "o", "--to=mcap", "--action-low=1,2,3"], "--action-low: expected 1 or 2 numbers, received 3"),
    "outside": (
        ["towels", "o", "--to=mcap", "--action-low=0", "--action-high=9"],
        "towels: episode 0: actions: step 2, element 1: expected a number in [0, 9], received -0.83",
    ),
    "env": (["towels", "o", "--to=mcap", "--env=a b"], "--env: expected an id of Gymnasium, such as Name-v0"),
    "fps": (["towels", "o", "--to=mcap", "--fps=-1"], "towels: fps: expected a number from 1e-06 to 1e+06, received -1.0"),
}


@pytest.mark.parametrize(("arguments", "reason"), ARGUMENTS.values(), ids=ARGUMENTS)
def test_arguments_are_refused_by_name(arguments, reason, tmp_path, monkeypatch):
    robot_data.write_lerobot(tmp_path / "towels")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError) as refused:
        run(*arguments)
    assert str(refused.value).startswith("spikeserve convert: ")
    assert reason in str(refused.value)
    assert [path.name for path in tmp_path.iterdir()] == ["towels"]


@pytest.mark.parametrize(("module", "form"), [("pyarrow", "lerobot"), ("mcap", "mcap"), ("minari", "minari")])
def test_a_missing_package_names_the_extra(module, form, tmp_path):
    robot_data.write_recording(tmp_path / "robot/0.cbor", [random_episode(SPACES["box"], 3)], SPACES["box"])
    blocked = f"import sys; sys.modules[{module!r}] = None; from spikeserve.__main__ import main; main() and exit(1)"
    arguments = ["convert", str(tmp_path / "robot"), str(tmp_path / "out-v0"), f"--to={form}"]
    done = subprocess.run([sys.executable, "-c", blocked, *arguments], capture_output=True, text=True)
    assert done.returncode == 1
    expected = f"{module}: expected the package, which the extra [robots] of spikeserve-train installs, received none"
    assert done.stderr == f"spikeserve convert: {expected}\n"
    assert [path.name for path in pathlib.Path(tmp_path).iterdir()] == ["robot"]


def test_a_server_records_and_spiketrain_trains(tmp_path):
    """From a session to LeRobot's format, and from there to training data and a policy."""
    recordings = tmp_path / "recordings"
    with (
        running_server(flags=[f"--record_dir={recordings}"]) as server,
        spikeserve.Client(server.grpc) as client,
        gymnasium.make("CartPole-v1", max_episode_steps=20) as environment,
        client.open_session("cartpole", spikeserve.SessionOptions(record=True)) as session,
    ):
        observation, _ = environment.reset(seed=1_000_000)
        reward, over = 0.0, False
        while not over:
            action = session.act(observation, reward).action
            observation, reward, terminated, truncated, _ = environment.step(action)
            over = terminated or truncated
        session.end_episode(reward, terminated, truncated)  # without the last observation
    run(recordings, tmp_path / "set", "--to=lerobot", "--fps=50")
    # LeRobot has no place for the names of a Discrete action's values.
    assert_equal(dataclasses.replace(read(recordings), action_names=()), read(tmp_path / "set"))
    run(tmp_path / "set", tmp_path / "set-v0", "--to=minari")
    run(tmp_path / "set", tmp_path / "set.cbor", "--to=spikeserve")
    if "SPIKETRAIN_PROGRAM" not in os.environ:
        return
    tiny = "--hidden_size=8 --heads=2 --layers=1 --ticks=4 --context=4 --iterations=2 --batch=2 --episodes=1 --no_baselines".split()
    data = f"--data={tmp_path}/set-v0,{tmp_path}/set.cbor"
    command = [os.environ["SPIKETRAIN_PROGRAM"], "train", data, f"--out={tmp_path}/run", *tiny]
    trained = subprocess.run(command, check=True, capture_output=True, text=True)
    assert "CartPole-v1, 1 episodes" in trained.stdout
    assert (tmp_path / "run/policy.safetensors").exists()
