"""The logic of the ROS 2 node without ROS: parameters, mapping files, the choice of what is published, diagnostics.

test_ros.py, of `make test-slow`, runs the node itself.
"""

import dataclasses
import math
import pathlib
import runpy
import sys
import threading
import types

import pytest
import spikeserve
import yaml

PACKAGE = pathlib.Path(__file__).parents[3] / "ros/spikeserve_ros"
sys.path.insert(0, str(PACKAGE))

from spikeserve_ros.acting import Acting, Task  # noqa: E402
from spikeserve_ros.connecting import Connecting  # noqa: E402
from spikeserve_ros.errors import ValueRefusedError  # noqa: E402
from spikeserve_ros.health import ERROR, OK, STALE, WARN, health  # noqa: E402
from spikeserve_ros.mapping import Joints, RobotMapping  # noqa: E402
from spikeserve_ros.parameters import PARAMETERS, Settings, target_return  # noqa: E402

SAFE = {"safe_action": [0.0]}
JOINTS = {"observation": [{"joint": "hinge", "field": "position"}]}


@dataclasses.dataclass
class Chosen:
    action: object
    source: str = "fresh"
    age: float = 0.01


class RecordingPilot:
    """Answers with what the test gives it, and keeps what it is told."""

    def __init__(self):
        self.next = Chosen(1)
        self.beats, self.endings = [], []

    def beat(self, observation, reward):
        self.beats.append((list(observation), reward))
        return self.next

    def end_episode(self, reward, **options):
        self.endings.append((reward, options))


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def pilot():
    return RecordingPilot()


def acting_of(clock, pilot, mapping=None, task=Task(2, 2, 1), **values):
    acting = Acting(mapping or RobotMapping(), Settings.of(SAFE | values), clock)
    acting.begin(pilot, task)
    return acting


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"rate": 0.0}, "rate: expected 0.1 to 1000.0, received 0.0"),
        ({"rate": "fast"}, "rate: expected a number, received 'fast'"),
        ({"rate": math.nan}, "rate: expected 0.1 to 1000.0, received nan"),
        ({"version": -1}, "version: expected 0 to 2147483647, received -1"),
        ({"input": "camera"}, "input: expected array or joints, received 'camera'"),
        ({"safe_action": []}, "safe_action: expected the numbers of an action, received []"),
        ({"safe_action": [math.inf]}, "safe_action: expected finite numbers, received [inf]"),
        ({"transport": "tcp"}, "transport: expected auto or stream or datagram, received 'tcp'"),
        ({"redundancy": 3}, "redundancy: expected 1 to 2, received 3"),
        ({"observation_timeout": 0}, "observation_timeout: expected 0.001 to 60.0, received 0.0"),
        ({"speed": 1.0}, "speed: expected a parameter, received 'speed'"),
    ],
)
def test_a_parameter_is_refused_by_its_name(values, text):
    with pytest.raises(ValueRefusedError) as error:
        Settings.of(SAFE | values)
    assert str(error.value) == text


def test_the_defaults_lack_only_the_safe_action():
    """Nobody else knows what is safe for a robot."""
    with pytest.raises(ValueRefusedError, match="safe_action"):
        Settings.of({})
    settings = Settings.of(SAFE)
    assert settings.period == 0.02
    assert settings.target_return is None
    assert target_return(500.0) == 500.0
    for parameter in PARAMETERS:
        assert parameter.description
        assert parameter.low is None or parameter.low <= parameter.default <= parameter.high


@pytest.mark.parametrize(
    ("given", "field"),
    [
        ([], "mapping"),
        ({"observations": []}, "observations"),
        ({"observation": []}, "observation"),
        ({"observation": ["hinge"]}, "observation[0]"),
        ({"observation": [{"field": "position"}]}, "observation[0].joint"),
        ({"observation": [{"joint": "hinge", "field": "speed"}]}, "observation[0].field"),
        ({"observation": [JOINTS["observation"][0] | {"function": "tan"}]}, "observation[0].function"),
        ({"observation": [JOINTS["observation"][0] | {"function": ["cos"]}]}, "observation[0].function"),
        ({"observation": [JOINTS["observation"][0] | {"scale": "2"}]}, "observation[0].scale"),
        ({"observation": [JOINTS["observation"][0] | {"offset": math.nan}]}, "observation[0].offset"),
        ({"observation": [JOINTS["observation"][0] | {"unit": "m"}]}, "observation[0].unit"),
        ({"actions": []}, "actions"),
        ({"actions": [[1.0], [1.0, 2.0]]}, "actions[1]"),
        ({"actions": [[1.0], [True]]}, "actions[1][0]"),
    ],
)
def test_a_mapping_is_refused_by_its_field(given, field):
    with pytest.raises(ValueRefusedError) as error:
        RobotMapping.parse(given)
    assert error.value.field == field


def test_a_file_is_named(tmp_path):
    path = tmp_path / "robot.yaml"
    for content in (b"observation: [", b"observation: 5", b"\xff\xfe"):
        path.write_bytes(content)
        with pytest.raises(ValueRefusedError, match="robot.yaml"):
            RobotMapping.read(str(path))
    with pytest.raises(ValueRefusedError, match="none.yaml"):
        RobotMapping.read(str(tmp_path / "none.yaml"))


def test_joints_become_an_observation_in_the_order_of_the_file():
    mapping = RobotMapping.parse(
        {
            "observation": [
                {"joint": "hinge", "field": "position", "function": "cos"},
                {"joint": "hinge", "field": "position", "function": "sin", "scale": 2, "offset": 1},
                {"joint": "slider", "field": "velocity"},
            ]
        }
    )
    fields = {"position": [0.5, math.pi / 2], "velocity": [-3.0, 0.0], "effort": []}

    def observed(names, **changes):
        joints = Joints()
        joints.update(names, fields | changes, 1.0)
        return mapping.observation(joints)

    assert observed(["slider", "hinge"]) == pytest.approx([0.0, 3.0, -3.0])
    with pytest.raises(ValueRefusedError, match="the joint hinge with its position"):
        observed(["slider"], position=[0.5], velocity=[0.0])
    with pytest.raises(ValueRefusedError, match="the joint slider with its velocity"):
        observed(["slider", "hinge"], velocity=[])
    with pytest.raises(ValueRefusedError, match="velocity: expected 2 elements, received 1"):
        observed(["slider", "hinge"], velocity=[0.0])
    with pytest.raises(ValueRefusedError, match="name: expected distinct joints"):
        observed(["hinge", "hinge"])
    with pytest.raises(ValueRefusedError, match=r"observation\[2\]: expected a finite number"):
        observed(["slider", "hinge"], velocity=[math.nan, 0.0])


def state(acting, **positions):
    """A JointState of joints with these positions, in their order."""
    names = list(positions)
    acting.observe_joints(names, {"position": list(positions.values()), "velocity": [], "effort": []})


def test_a_policy_that_names_joints_needs_no_mapping(clock, pilot):
    task = Task(2, 2, 1, ("elbow/position", "wrist/position"))
    acting = acting_of(clock, pilot, task=task, input="joints")
    state(acting, wrist=2.0, elbow=1.0, gripper=9.0)
    acting.beat()
    assert pilot.beats == [([1.0, 2.0], 0.0)]


@pytest.mark.parametrize(
    ("names", "text"),
    [
        ((), "mapping: expected a file, because the policy names no elements"),
        (("elbow/position", "angle"), "the policy's element 1: expected JOINT/FIELD"),
    ],
)
def test_other_names_need_a_mapping(clock, pilot, names, text):
    with pytest.raises(ValueRefusedError, match=text):
        acting_of(clock, pilot, task=Task(2, 2, 1, names), input="joints")


def test_elements_with_the_names_of_the_policy_may_have_any_order():
    rows = [{"joint": "hinge", "field": "position", "name": "angle"}, {"joint": "slider", "field": "position"}]
    assert RobotMapping.parse({"observation": rows}).names == ()  # the order says it
    rows[1]["name"] = "x"
    assert RobotMapping.parse({"observation": rows}).names == ("angle", "x")


def test_two_publishers_share_the_topic_of_the_joints(clock, pilot):
    """Each with joints of its own, in any order; the observation is as old as the older of them."""
    elements = [{"joint": name, "field": "position"} for name in ("elbow", "finger")]
    acting = acting_of(clock, pilot, RobotMapping.parse({"observation": elements}), observation_timeout=0.2)

    def hear(names, positions):
        acting.observe_joints(names, {"position": positions, "velocity": [], "effort": []})

    hear(["shoulder", "elbow"], [1.0, 2.0])
    assert acting.beat().source == "lost"
    assert "the joint finger with its position" in acting.refusal
    clock.now += 0.1
    hear(["finger"], [3.0])
    assert acting.beat().source == "fresh"
    hear(["elbow", "shoulder"], [4.0, 5.0])
    acting.beat()
    assert [beat[0] for beat in pilot.beats] == [[2.0, 3.0], [4.0, 3.0]]
    clock.now += 0.15
    hear(["elbow", "shoulder"], [6.0, 7.0])
    assert acting.beat().source == "fresh"
    clock.now += 0.1  # the publisher of the finger has stopped
    hear(["elbow", "shoulder"], [8.0, 9.0])
    assert acting.beat().source == "lost"
    acting.end_episode(terminated=True)
    hear(["elbow", "shoulder"], [8.0, 9.0])
    assert acting.beat().source == "lost"  # an old finger belongs to no new episode


def test_a_discrete_action_becomes_its_numbers():
    mapping = RobotMapping.parse({"actions": [[-10.0], [10.0]]})
    assert mapping.command(1) == [10.0]
    with pytest.raises(ValueRefusedError, match="action: expected 0 to 1, received 2"):
        mapping.command(2)
    assert RobotMapping().command(1) == [1.0]
    assert mapping.command([0.5, -0.5]) == [0.5, -0.5]


@pytest.mark.parametrize(
    ("task", "mapping", "field"),
    [
        (Task(2, 2, 1), JOINTS, "observation"),
        (Task(1, 3, 1), JOINTS | {"actions": [[0.0], [1.0]]}, "actions"),
        (Task(1, None, 1), JOINTS | {"actions": [[0.0], [1.0]]}, "actions"),
        (Task(1, 2, 1), JOINTS | {"actions": [[0.0, 1.0], [1.0, 0.0]]}, "safe_action"),
        (Task(1, None, 2), JOINTS, "safe_action"),
    ],
)
def test_what_does_not_fit_the_policy_is_refused(task, mapping, field):
    with pytest.raises(ValueRefusedError) as error:
        task.check(RobotMapping.parse(mapping), Settings.of(SAFE))
    assert error.value.field == field


def test_without_a_server_or_an_observation_the_safe_action_is_published(clock, pilot):
    acting = Acting(RobotMapping(), Settings.of(SAFE), clock)
    acting.observe_vector([0.0, 0.0])
    assert acting.beat().source == "lost"
    acting.begin(pilot, Task(2, 2, 1))
    assert acting.beat().command == [0.0]
    assert pilot.beats == []
    acting.observe_vector([0.0, 0.0])
    assert acting.beat().source == "fresh"


def test_an_old_observation_is_lost(clock, pilot):
    acting = acting_of(clock, pilot, observation_timeout=0.2)
    acting.observe_vector([0.1, 0.2])
    clock.now += 0.19
    assert acting.beat().command == [1.0]
    clock.now += 0.02
    step = acting.beat()
    assert (step.command, step.source) == ([0.0], "lost")
    assert step.age == pytest.approx(0.21)
    assert len(pilot.beats) == 1


def test_a_wrong_observation_does_not_replace_the_last_one(clock, pilot):
    acting = acting_of(clock, pilot)
    acting.observe_vector([0.1, 0.2])
    acting.observe_vector([0.1])
    assert acting.refusal == "observation: expected 2 elements, received 1"
    acting.observe_vector([0.1, math.nan])
    assert acting.refusal == "observation[1]: expected a finite number, received nan"
    acting.beat()
    assert pilot.beats == [([0.1, 0.2], 0.0)]


def test_rewards_between_two_beats_add_up(clock, pilot):
    acting = acting_of(clock, pilot)
    acting.observe_vector([0.0, 0.0])
    for reward in (1.0, 0.5, math.nan):
        acting.reward(reward)
    acting.beat()
    acting.beat()
    assert [reward for _, reward in pilot.beats] == [1.5, 0.0]
    assert acting.refusal.startswith("reward[0]: expected a finite number")


def test_safe_for_discrete_actions_is_the_robots_own(clock, pilot):
    mapping = RobotMapping.parse({"actions": [[-10.0], [10.0]]})
    acting = acting_of(clock, pilot, mapping)
    acting.observe_vector([0.0, 0.0])
    assert acting.beat().command == [10.0]
    pilot.next = Chosen(0, "safe")
    assert acting.beat().command == [0.0]


def test_safe_for_vectors_is_the_pilots_way_to_it(clock, pilot):
    acting = acting_of(clock, pilot, task=Task(2, None, 1))
    acting.observe_vector([0.0, 0.0])
    pilot.next = Chosen([0.7], "safe")
    assert acting.beat().command == [0.7]


def test_the_end_of_an_episode_takes_its_reward_and_the_target_along(clock, pilot):
    acting = acting_of(clock, pilot, target_return=100.0)
    acting.observe_vector([0.0, 0.0])
    acting.beat()
    acting.reward(3.0)
    acting.target_return = 200.0
    acting.end_episode(terminated=True)
    assert pilot.endings == [(3.0, {"terminated": True, "truncated": False, "target_return": 200.0})]
    assert acting.beat().source == "lost"  # an observation of the last episode begins no new one
    acting.observe_vector([0.0, 0.0])
    acting.beat()
    assert pilot.beats[-1] == ([0.0, 0.0], 0.0)


def first_session(monkeypatch, target):
    """Returns the target of the session that Connecting opens, and the task, for a policy that aims at 500."""
    space = spikeserve.Discrete(2)
    policy = {"name": "cartpole", "version": 1, "is_default": True, "observation_size": 2, "action_space": space}
    served = types.SimpleNamespace(**policy, observation_features=(), target_return=500.0)
    client = types.SimpleNamespace(list_policies=lambda: [served], close=lambda: None)
    sessions, is_open = [], threading.Event()

    def open_pilot(*_, session, **__):
        sessions.append(session)
        is_open.set()
        return types.SimpleNamespace(close=lambda: None)

    monkeypatch.setattr(spikeserve, "Client", lambda _: client)
    monkeypatch.setattr(spikeserve, "Pilot", open_pilot)
    connecting = Connecting(Settings.of(SAFE | {"target_return": 100.0}), RobotMapping(), lambda: target)
    assert is_open.wait(30), connecting.error
    connecting.close()
    return sessions[0].target_return, connecting.take()[1]


def test_the_target_goes_back_to_that_of_the_policy_file(clock, pilot, monkeypatch):
    target, task = first_session(monkeypatch, 200.0)
    assert target == 200.0  # that of now, not that of the start
    acting = acting_of(clock, pilot, task=task, target_return=100.0)
    acting.target_return = target_return(-1e9)
    acting.end_episode(terminated=True)
    assert first_session(monkeypatch, None)[0] is None
    acting = acting_of(clock, pilot, task=first_session(monkeypatch, None)[1])
    acting.end_episode(terminated=True)  # of whatever version the server has chosen
    assert [options["target_return"] for _, options in pilot.endings] == [500.0, None]


def counts(**some):
    return {"fresh": 0, "held": 0, "local": 0, "safe": 0, "lost": 0} | some


@pytest.mark.parametrize(
    ("now", "refusal", "level", "text"),
    [
        (counts(), "", STALE, "no beat"),
        (counts(fresh=50), "", OK, "every action is fresh"),
        (counts(fresh=48, held=1, local=1), "", WARN, "2 of 50"),
        (counts(fresh=49, safe=1), "", ERROR, "no answer of the server"),
        (counts(fresh=49, lost=1), "", ERROR, "no recent observation"),
        (counts(lost=1), "name: expected the joint hinge", ERROR, "name: expected the joint hinge"),
        (counts(fresh=50), "reward[0]: expected", WARN, "reward[0]"),
    ],
)
def test_diagnostics_say_what_was_published(now, refusal, level, text):
    before = counts(fresh=10)
    found = health(now | {"fresh": now["fresh"] + 10}, before, {"reconnects": 3}, refusal)
    assert found.level == level
    assert text in found.message
    assert found.values["reconnects"] == "3"


def test_the_shipped_files_can_be_used():
    [given] = yaml.safe_load((PACKAGE / "config/cartpole.yaml").read_text()).values()
    settings = Settings.of(given["ros__parameters"])
    mapping = RobotMapping.read(str(PACKAGE / "config/cartpole_joints.yaml"))
    Task(4, 2, 1).check(mapping, settings)


def test_the_launch_file_starts_the_node(monkeypatch):
    """With stand-ins for launch and launch_ros, which no index of Python packages has."""
    made = []

    def recorder(name):
        def record(*arguments, **keywords):
            made.append((name, arguments, keywords))
            return name

        return record

    for module, names in (
        ("launch", ["LaunchDescription"]),
        ("launch.actions", ["DeclareLaunchArgument"]),
        ("launch.substitutions", ["LaunchConfiguration"]),
        ("launch_ros", []),
        ("launch_ros.actions", ["Node"]),
    ):
        stand_in = types.ModuleType(module)
        for name in names:
            setattr(stand_in, name, recorder(name))
        monkeypatch.setitem(sys.modules, module, stand_in)
    runpy.run_path(str(PACKAGE / "launch/spikeserve.launch.py"))["generate_launch_description"]()
    [(_, _, node)] = [each for each in made if each[0] == "Node"]
    assert (node["package"], node["executable"], node["name"]) == ("spikeserve_ros", "node", "spikeserve")
    [(_, arguments, options)] = [each for each in made if each[1][:1] == ("params",) and "default_value" in each[2]]
    assert pathlib.Path(options["default_value"]).exists()
    setup = (PACKAGE / "setup.py").read_text()
    for path in [*PACKAGE.glob("launch/*.py"), *PACKAGE.glob("config/*")]:
        assert f"{path.parent.name}/{path.name}" in setup
