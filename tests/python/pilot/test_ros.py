"""The ROS 2 node plays CartPole with a robot in another process, through topics, and is safe without its server.

Needs the environment that `deploy/setup.sh build ros` makes; is skipped without it.
"""

import contextlib
import json
import os
import pathlib
import subprocess

import pytest
from restartable_server import RestartableServer
from serving import DEADLINE_SECONDS, running_server

ROOT = pathlib.Path(__file__).parents[3]
PYTHON = ROOT / "build/ros/venv/bin/python"
PACKAGE = ROOT / "ros/spikeserve_ros"
ROBOT = ROOT / "tests/ros/cartpole_robot.py"
SECONDS = 300  # DDS needs seconds to find the other process on a busy machine

pytestmark = pytest.mark.skipif(not PYTHON.exists(), reason="without rclpy, which `deploy/setup.sh build ros` installs")


@pytest.fixture
def environment(tmp_path):
    """Nodes of other tests at the same time must not hear these."""
    path = os.pathsep.join([str(PACKAGE), os.environ["PYTHONPATH"]])
    domain = str(1 + os.getpid() % 100)
    of_ros = {"ROS_DOMAIN_ID": domain, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOG_DIR": str(tmp_path)}
    return os.environ | {"PYTHONPATH": path} | of_ros


@contextlib.contextmanager
def running_node(environment, server, **parameters):
    given = {"server": server, "policy": "cartpole", "rate": 20.0, "observation_timeout": 20.0} | parameters
    arguments = ["--params-file", PACKAGE / "config/cartpole.yaml"]
    for name, value in given.items():
        arguments += ["-p", f"{name}:={value}"]
    command = [PYTHON, "-m", "spikeserve_ros.node", "--ros-args", *arguments]
    process = subprocess.Popen([*map(str, command)], env=environment, stderr=subprocess.PIPE, text=True)
    try:
        yield process
        process.terminate()
        process.wait(timeout=DEADLINE_SECONDS)
    finally:
        process.kill()
        process.communicate()


def play(environment, kind, episodes, most_steps):
    """Returns the episodes of the robot, and the diagnostics that it saw last."""
    finished = subprocess.run(
        [PYTHON, ROBOT, kind, str(episodes), str(most_steps)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=SECONDS,
    )
    assert finished.returncode == 0, finished.stderr
    *played, diagnostics = map(json.loads, finished.stdout.splitlines())
    return played, diagnostics


@pytest.mark.parametrize("kind", ["array", "joints"])
def test_cartpole_across_two_processes(environment, kind):
    more = {"input": kind}
    if kind == "joints":
        more["mapping"] = PACKAGE / "config/cartpole_joints.yaml"
    with running_server() as addresses, running_node(environment, addresses.grpc, **more):
        played, diagnostics = play(environment, kind, 2, 100)
        assert len(played) == 2
        for episode in played:
            # Chance balances for about 20 steps. An action that comes late moves the robot without a new decision.
            assert episode["return"] > 50
        assert int(diagnostics["values"]["beats_fresh"]) > 0
        [session] = addresses.admin.ListSessions().sessions
        assert session.episode >= 1


def run_node(environment, *arguments):
    command = [PYTHON, "-m", "spikeserve_ros.node", "--ros-args", *arguments]
    finished = subprocess.run([*map(str, command)], env=environment, capture_output=True, text=True, timeout=SECONDS)
    return finished.returncode, finished.stderr


def test_a_parameter_out_of_its_range_ends_the_node_with_its_name(environment):
    status, text = run_node(environment, "-p", "rate:=5000.0")
    assert status == 2
    assert "rate out of range" in text
    status, text = run_node(environment)
    assert status == 2
    assert "safe_action: expected the numbers of an action" in text


LISTENER = """
import json, rclpy
from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import Float32MultiArray
rclpy.init()
node, actions, diagnostics = rclpy.create_node("listener"), [], []
node.create_subscription(Float32MultiArray, "/spikeserve/action", actions.append, 1)
node.create_subscription(DiagnosticArray, "/diagnostics", diagnostics.append, 1)
while len(actions) < 5 or not diagnostics:
    rclpy.spin_once(node)
commands = [[list(action.data), action.layout.dim[0].label] for action in actions]
print(json.dumps([commands, diagnostics[0].status[0].level[0], diagnostics[0].status[0].message]))
"""


def test_without_its_server_the_node_is_safe(environment):
    with running_node(environment, "127.0.0.1:1", safe_action=[0.25]):
        finished = subprocess.run(
            [PYTHON, "-c", LISTENER], env=environment, capture_output=True, text=True, timeout=SECONDS
        )
    assert finished.returncode == 0, finished.stderr
    commands, level, message = json.loads(finished.stdout)
    assert all(command == [[0.25], "lost"] for command in commands)
    assert level == 2
    assert message


SOURCES = """
import json, rclpy
from std_msgs.msg import Float32MultiArray
rclpy.init()
node, seen = rclpy.create_node("sensor"), [None]
publisher = node.create_publisher(Float32MultiArray, "/spikeserve/observation", 1)
node.create_timer(0.02, lambda: publisher.publish(Float32MultiArray(data=[0.0, 0.0, 0.01, 0.0])))
def on_action(message):
    if message.layout.dim[0].label != seen[0]:
        seen[0] = message.layout.dim[0].label
        print(json.dumps([seen[0], list(message.data)]), flush=True)
node.create_subscription(Float32MultiArray, "/spikeserve/action", on_action, 1)
rclpy.spin(node)
"""


def test_when_the_server_is_killed_the_safe_action_follows_until_it_is_back(environment):
    server = RestartableServer()
    server.start()
    command = [PYTHON, "-c", SOURCES]
    with (
        contextlib.ExitStack() as stack,
        running_node(environment, server.address, safe_action=[0.25]),
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as sensor,
    ):
        stack.callback(server.kill)
        stack.callback(sensor.kill)
        assert await_source(sensor, "fresh") in ([0.0], [1.0])
        server.kill()
        assert await_source(sensor, "safe") == [0.25]
        server.start()
        assert await_source(sensor, "fresh") in ([0.0], [1.0])
        sensor.kill()


def await_source(sensor, wanted):
    """Returns the first action that has this source."""
    for line in sensor.stdout:
        source, action = json.loads(line)
        if source == wanted:
            return action
    raise AssertionError(f"expected an action that is {wanted}, received none")
