"""Where data have names, a name decides and not a place: it is matched, or refused by name."""

import json
from dataclasses import replace

import cbor2
import gymnasium
import minari
import numpy as np
import pytest
import robot_data
from gymnasium import spaces
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from spikeserve.conversion import Selection, convert
from spikeserve.conversion.converting import read
from spikeserve.flat_spaces import FlatEnvironment
from spikeserve.imitation.datasets import check_spaces, open_dataset, read_dataset

STILL = {"shoulder": 1.0, "elbow": -2.0, "finger": 0.04}
JOINTS = Selection(observation=("/joint_states.position",), action="/command.data")


def joint_state(*names, **values):
    return {"name": list(names), "position": [(STILL | values)[name] for name in names], "velocity": []}


def write(path, orders, joints="/joint_states", **further):
    """Writes a log in which joints that stand still come in several orders, and a command after each."""
    states = [(k / 10, joint_state(*order)) for k, order in enumerate(orders)]
    commands = [(k / 10 + 0.01, {"data": [k * 0.1]}) for k in range(len(orders))]
    robot_data.write_json_log(path, {joints: states, "/command": commands} | further)


def rows(data, episode=0):
    return data.episodes[episode].observations[:-1].tolist()


def test_joints_are_matched_by_name_in_every_message_and_log(tmp_path):
    write(tmp_path / "log_2.mcap", [["shoulder", "elbow"], ["elbow", "shoulder"]] * 2)
    write(tmp_path / "log_10.mcap", [["elbow", "shoulder"]] * 3)
    data = read(tmp_path, selection=JOINTS)
    assert data.observation_names == ("shoulder", "elbow")
    assert rows(data, 0) == [[1.0, -2.0]] * 4
    assert rows(data, 1) == [[1.0, -2.0]] * 3
    write(tmp_path / "log_11.mcap", [["elbow", "finger"]])
    with pytest.raises(ValueError, match=r"log_11.mcap: .*expected shoulder, elbow, as in .*log_2.mcap, received elbow"):
        read(tmp_path, selection=JOINTS)


def test_joints_of_ros_messages_are_matched_by_name(tmp_path):
    """CDR: a header of 4 bytes, then texts and sequences with their lengths, aligned to 4 and 8 bytes."""

    def text(value):
        raw = value.encode() + b"\0"
        return len(raw).to_bytes(4, "little") + raw + b"\0" * (-len(raw) % 4)

    def encode(names):
        body = len(names).to_bytes(4, "little") + b"".join(map(text, names))
        body += len(names).to_bytes(4, "little")
        body += b"\0" * (-len(body) % 8)
        return b"\0\1\0\0" + body + np.array([STILL[name] for name in names], "<f8").tobytes()

    orders = [("shoulder", "elbow"), ("elbow", "shoulder"), ("shoulder", "elbow")]
    schema = "string[] name\nfloat64[] position"
    topics = [
        ("/joint_states", "m/msg/JointState", schema, [(k, encode(names)) for k, names in enumerate(orders)]),
        ("/goal", "m/msg/JointState", schema, [(k + 0.5, encode(names)) for k, names in enumerate(orders)]),
    ]
    robot_data.write_log(tmp_path / "ros.mcap", topics, "cdr", "ros2msg")
    selection = Selection(("/joint_states.position",), "/goal.position", action_low=(-3,), action_high=(3,))
    data = read(tmp_path / "ros.mcap", selection=selection)
    assert rows(data) == [[1.0, -2.0]] * 3
    assert data.episodes[0].actions.tolist() == [[1.0, -2.0]] * 3
    assert data.action_names == ("shoulder", "elbow")


def test_publishers_that_share_a_topic_are_merged_by_name(tmp_path):
    write(tmp_path / "two.mcap", [["shoulder", "elbow"], ["finger"]] * 3)
    data = read(tmp_path / "two.mcap", selection=JOINTS)
    assert data.observation_names == ("shoulder", "elbow", "finger")
    np.testing.assert_array_equal(rows(data), [np.float32([1.0, -2.0, 0.04])] * 5)
    assert any("left out 1 actions before the first observation" in note for note in data.notes)


def test_names_beside_an_outer_message_and_of_single_numbers_decide(tmp_path):
    def log(state):
        return {"/s": [(k, state(k)) for k in range(6)], "/command": [(k + 0.1, {"data": [k]}) for k in range(6)]}

    names = (["a", "b"], ["b", "a"])
    robot_data.write_json_log(
        tmp_path / "controller.mcap",
        log(lambda k: {"joint_names": names[k % 2], "actual": {"positions": [k % 2, 1 - k % 2]}}),
    )
    data = read(tmp_path / "controller.mcap", selection=Selection(("/s.actual.positions",), "/command"))
    assert rows(data) == [[0, 1]] * 6
    assert data.observation_names == ("a", "b")
    robot_data.write_json_log(
        tmp_path / "sensors.mcap", log(lambda k: {"name": ("left", "right")[k % 2], "value": [10, 20][k % 2]})
    )
    data = read(tmp_path / "sensors.mcap", selection=Selection(("/s.value",), "/command"))
    assert rows(data) == [[10, 20]] * 5


@pytest.mark.parametrize("key", ["jointNames", "labels", "sensor_ids"])
def test_lists_of_texts_beside_numbers_are_their_names(key, tmp_path):
    orders = [["a", "b"], ["b", "a"]] * 2
    states = [(k, {key: order, "position": [STILL.get(n, ord(n)) for n in order]}) for k, order in enumerate(orders)]
    log = {"/joint_states": states, "/command": [(k + 0.5, {"data": [0.1 * k]}) for k in range(4)]}
    robot_data.write_json_log(tmp_path / "log.mcap", log)
    data = read(tmp_path / "log.mcap", selection=JOINTS)
    assert (data.observation_names, rows(data)) == (("a", "b"), [[97, 98]] * 4)


REFUSED = {
    "twice": ({"name": ["a", "a"], "position": [1.0, 2.0]}, "name: expected distinct names"),
    "fewer": ({"name": ["a"], "position": [1.0, 2.0]}, "name: expected 2 names, one a number, received 1"),
    "none": ({"position": [1.0, 2.0]}, "message 1: expected names of its numbers, as in the first message, received none"),
}


@pytest.mark.parametrize(("second", "reason"), REFUSED.values(), ids=REFUSED)
def test_names_that_do_not_fit_are_refused(second, reason, tmp_path):
    states = [(0, {"name": ["a", "b"], "position": [1.0, 2.0]}), (1, second)]
    log = {"/joint_states": states, "/command": [(2, {"data": [0.5]})]}
    robot_data.write_json_log(tmp_path / "log.mcap", log)
    with pytest.raises(ValueError) as refused:
        read(tmp_path / "log.mcap", selection=JOINTS)
    assert reason in str(refused.value)


@pytest.mark.parametrize("form", ["lerobot", "mcap", "minari", "spikeserve"])
def test_every_format_keeps_the_names(form, tmp_path):
    write(tmp_path / "log.mcap", [["shoulder", "elbow"]] * 3)
    out = tmp_path / ("out.cbor" if form == "spikeserve" else "out-v0")
    convert(tmp_path / "log.mcap", out, form, selection=JOINTS)
    assert read(out).observation_names == ("shoulder", "elbow")


def recording(path, **names):
    """Writes a recording of two numbers and three actions, with names as those of a server have them."""
    robot_data.write_recording(path, [(np.zeros((3, 2)), [0, 2], [0.0] * 2)], {"n": 3})
    path.write_bytes(cbor2.dumps(cbor2.loads(path.read_bytes()) | {"recipe": names}))
    return path


def test_an_index_has_a_name_for_each_of_its_values(tmp_path):
    values = ["left", "stay", "right"]
    recording(tmp_path / "a/0.cbor", observation_names=["x", "y"], action_names=values)
    recording(tmp_path / "a/1.cbor")  # a file without names fits all
    for form, out in (("mcap", "logs"), ("minari", "set-v0"), ("spikeserve", "b.cbor")):
        convert(tmp_path / "a", tmp_path / out, form)
        assert read(tmp_path / out).action_names == tuple(values)
        assert read(tmp_path / out).observation_names == ("x", "y")


UNUSABLE = {
    "few": (["x"], "names of the observation: expected 2 different names, or none, received ('x',)"),
    "equal": (["x", "x"], "names of the observation: expected 2 different names, or none, received ('x', 'x')"),
    "unprintable": (["x", "\x1b[2J"], "names of the observation: expected 1 to 256 bytes of printable characters"),
}


@pytest.mark.parametrize(("names", "reason"), UNUSABLE.values(), ids=UNUSABLE)
def test_names_that_a_policy_cannot_have_are_refused(names, reason, tmp_path):
    with pytest.raises(ValueError) as refused:
        read(recording(tmp_path / "0.cbor", observation_names=names))
    assert reason in str(refused.value)


def test_logs_and_recordings_with_other_names_are_matched_or_refused(tmp_path):
    arm = replace(JOINTS, environment="Arm-v0")
    for name, order in (("a", ["shoulder", "elbow"]), ("b", ["elbow", "shoulder"])):
        write(tmp_path / f"{name}.mcap", [order] * 3)
        convert(tmp_path / f"{name}.mcap", tmp_path / "logs" / name, "mcap", selection=arm)
        convert(tmp_path / f"{name}.mcap", tmp_path / f"data/{name}.cbor", "spikeserve", selection=arm)
    data = read(tmp_path / "logs")  # of this package: the names are in the metadata of each log
    assert rows(data, 0) == rows(data, 1) == [[1.0, -2.0]] * 3
    with pytest.raises(ValueError, match=r"b.cbor: expected the names \('shoulder', 'elbow'\) as in .*a.cbor"):
        read(tmp_path / "data")


def test_names_of_lerobot_are_read_in_every_form(tmp_path):
    robot_data.write_lerobot(tmp_path / "towels")
    info = tmp_path / "towels/meta/info.json"
    fitting = (["x", "y"], {"motors": ["x", "y"]}, {"y": 1, "x": 0}, {"left": ["x"], "right": ["y"]})
    for names in (*fitting, ["x", "x"], ["x"]):
        value = json.loads(info.read_text())
        value["features"]["action"]["names"] = names
        info.write_text(json.dumps(value))
        data = read(tmp_path / "towels")
        assert data.action_names == (("x", "y") if names in fitting else ())
        assert any("left out: the names of action" in note for note in data.notes) == (names not in fitting)


def lerobot_export(folder):
    episodes = [(np.full((k + 2, 3), k, np.float32), list(range(k + 1)), [0.0] * (k + 1)) for k in range(3)]
    robot_data.write_recording(folder / "robot/0.cbor", episodes, {"n": 3})
    convert(folder / "robot/0.cbor", folder / "set", "lerobot")
    return folder / "set/meta/spikeserve.json"


def test_the_sidecar_of_an_export_is_matched_by_episode(tmp_path):
    path = lerobot_export(tmp_path)
    value = json.loads(path.read_text())
    expected = [episode.seed for episode in read(tmp_path / "set").episodes]
    path.write_text(json.dumps(value | {"episodes": value["episodes"][::-1]}))
    assert [episode.seed for episode in read(tmp_path / "set").episodes] == expected
    for change, reason in (
        ({"steps": 7}, r"episodes\[0\].steps: expected 1, as in the data, received 7"),
        ({"fingerprint": 1}, r"episodes\[0\].fingerprint: expected \d+, of the data, received 1"),
        ({"episode_index": 2}, r"episode_index: expected each of 0 to 2 once, received 2"),
    ):
        episodes = [value["episodes"][0] | change, *value["episodes"][1:]]
        path.write_text(json.dumps(value | {"episodes": episodes}))
        with pytest.raises(ValueError, match=reason):
            read(tmp_path / "set")


# Dict observations of Minari, and of an environment


class TwoParts(gymnasium.Env):
    """Its observation is a Dict whose entries are not in the order of their names, as those of a data set are."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Dict([("wrist", spaces.Box(-9, 9, (2,))), ("arm", spaces.Box(-9, 9, (1,)))])

    def reset(self, *, seed=None, options=None):
        return {"wrist": np.float32([1, 2]), "arm": np.float32([3])}, {}


def record(folder, space, observation, action_space=spaces.Discrete(2), ends=(False, False, True)):
    """Writes a data set of one episode with the same observation at every step."""
    (folder / "data").mkdir(parents=True)
    storage = MinariStorage.new(folder / "data", observation_space=space, action_space=action_space)
    steps = len(ends)
    stacked = {key: np.stack([value] * (steps + 1)) for key, value in observation.items()}
    actions = [action_space.sample() for _ in range(steps)]
    cut = [False] * steps
    storage.update_episodes([EpisodeBuffer(0, 0, None, stacked, actions, [1.0] * steps, list(ends), cut)])
    storage.update_metadata({"dataset_id": folder.name, "minari_version": minari.__version__})
    return folder


def entries(**changes):
    shapes = {"arm": (1,), "wrist": (2,)} | changes
    return spaces.Dict({key: spaces.Box(-9, 9, shape) for key, shape in shapes.items() if shape})


def observed(space):
    return {key: np.arange(np.prod(box.shape), dtype=np.float32).reshape(box.shape) for key, box in space.items()}


@pytest.mark.parametrize("wrapper", [lambda env: env, gymnasium.wrappers.FlattenObservation], ids=["dict", "flattened"])
def test_the_entries_of_a_dict_are_matched_by_name(wrapper, tmp_path):
    observation, _ = TwoParts().reset()
    folder = record(tmp_path / "parts-v0", entries(), observation)
    environment = FlatEnvironment(wrapper(TwoParts()))
    live, _ = environment.reset()
    (episode,) = read_dataset(folder, environment)
    np.testing.assert_array_equal(episode.observations[0], live)
    np.testing.assert_array_equal(live, [1, 2, 3])
    data = read(folder)
    assert data.observation_names == ("arm", "wrist[0]", "wrist[1]")
    np.testing.assert_array_equal(data.episodes[0].observations[0], [3, 1, 2])


DIFFERENT = {
    "missing": (entries(wrist=None), spaces.Discrete(2), "observation_space: expected the entries arm, wrist, received arm"),
    "renamed": (entries(wrist=None, hand=(2,)), spaces.Discrete(2), "the entries arm, wrist, received arm, hand"),
    "shape": (entries(arm=(2,)), spaces.Discrete(2), r"observation_space\['arm'\]: expected Box"),
    "actions": (entries(), spaces.Discrete(3), r"action_space: expected Discrete\(2\), as the environment has"),
}


@pytest.mark.parametrize(("space", "actions", "reason"), DIFFERENT.values(), ids=DIFFERENT)
def test_a_data_set_and_its_environment_are_compared_first(space, actions, reason, tmp_path):
    folder = record(tmp_path / "parts-v0", space, observed(space), actions)
    with pytest.raises(ValueError, match=reason):
        check_spaces(open_dataset(folder), FlatEnvironment(TwoParts()), str(folder))


def test_an_end_in_the_middle_of_an_episode_is_refused(tmp_path):
    space = entries()
    folder = record(tmp_path / "parts-v0", space, observed(space), ends=(False, True, True))
    with pytest.raises(ValueError, match="episode 0: terminations: step 1: expected true only at the last step"):
        read(folder)
    path = lerobot_export(tmp_path)
    assert path.exists()
    from pyarrow import parquet

    file = tmp_path / "set/data/chunk-000/file-000.parquet"
    table = parquet.read_table(file)
    done = table.column_names.index("next.done")
    table = table.set_column(done, "next.done", [[True, True, True, True, False, True]])
    parquet.write_table(table, file)
    with pytest.raises(ValueError, match="episode 1: next.done: step 0: expected true only at the last step"):
        read(tmp_path / "set")


BAD_NUMBERS = {
    "huge": ({"observations": [0.0, 1e30, 0.0, 0.0]}, "observations: step 1, element 0: expected a finite number of at most"),
    "reward": ({"rewards": [0.0, -1e300, 0.0]}, "rewards: step 1: expected a finite number of at most"),
    "weight": ({"weights": [1.0, -1.0, 1.0]}, "weights: step 1: expected a number of at least 0, received -1"),
    "asked": ({"asked_return": float("nan")}, "asked_return: expected a finite number, received nan"),
    "seed": ({"seed": -1}, "seed: expected 0 to 2^64 - 1, received -1"),
}


@pytest.mark.parametrize(("fields", "reason"), BAD_NUMBERS.values(), ids=BAD_NUMBERS)
def test_numbers_that_spiketrain_refuses_are_refused(fields, reason, tmp_path):
    path = tmp_path / "robot/0.cbor"
    robot_data.write_recording(path, [(np.zeros((4, 1)), [0, 1, 0], [0.0] * 3)], {"n": 2})
    value = cbor2.loads(path.read_bytes())
    value["episodes"][0] |= fields
    path.write_bytes(cbor2.dumps(value))
    with pytest.raises(ValueError) as refused:
        read(path)
    assert reason in str(refused.value)


def test_an_action_that_rounding_left_outside_is_rounded(tmp_path):
    path = tmp_path / "robot/0.cbor"
    outside = float(np.nextafter(np.float32(1), np.float32(2)))
    episode = (np.zeros((3, 1)), [[outside], [-1.0]], [0.0] * 2)
    robot_data.write_recording(path, [episode], {"low": [-1.0], "high": [1.0]})
    assert read(path).episodes[0].actions.tolist() == [[1.0], [-1.0]]
