"""The node: topics, services, parameters and the timer around `Acting`. All of it runs on one thread."""

import logging
import sys
import time
from collections.abc import Sequence

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32, Float32MultiArray, MultiArrayDimension
from std_srvs.srv import SetBool, Trigger

from spikeserve_ros.acting import Acting
from spikeserve_ros.connecting import Connecting
from spikeserve_ros.errors import ValueRefusedError
from spikeserve_ros.health import health
from spikeserve_ros.mapping import RobotMapping
from spikeserve_ros.parameters import PARAMETERS, Parameter, Settings, target_return

DIAGNOSTICS_SECONDS = 1.0
NEWEST = 1  # depth of the queues of observations and actions: an old one is of no use
REWARDS = 100  # each of them counts


def describe(parameter: Parameter) -> ParameterDescriptor:
    """Returns what `ros2 param describe` shows."""
    descriptor = ParameterDescriptor(description=parameter.description, read_only=parameter.fixed)
    descriptor.additional_constraints = " or ".join(parameter.choices)
    if isinstance(parameter.default, float) and parameter.low is not None:
        descriptor.floating_point_range = [FloatingPointRange(from_value=parameter.low, to_value=parameter.high)]
    if isinstance(parameter.default, int) and parameter.low is not None:
        descriptor.integer_range = [IntegerRange(from_value=int(parameter.low), to_value=int(parameter.high), step=1)]
    return descriptor


class ActingNode(Node):
    """Acts from its construction on: with safe actions until the server and the robot have answered."""

    def __init__(self) -> None:
        super().__init__("spikeserve")
        settings = Settings.of({parameter.name: self._declare(parameter) for parameter in PARAMETERS})
        self._settings = settings
        mapping = RobotMapping.read(settings.mapping) if settings.mapping else RobotMapping()
        self._acting = Acting(mapping, settings, time.monotonic)
        self._beats_before = dict(self._acting.beats)
        self._actions = self.create_publisher(Float32MultiArray, "~/action", NEWEST)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 1)
        if settings.input == "joints":
            self.create_subscription(JointState, "~/joint_states", self._on_joints, NEWEST)
        else:
            self.create_subscription(Float32MultiArray, "~/observation", self._on_observation, NEWEST)
        self.create_subscription(Float32, "~/reward", lambda message: self._acting.reward(message.data), REWARDS)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(SetBool, "~/end_episode", self._on_end_episode)
        self.add_on_set_parameters_callback(self._on_parameters)
        self.create_timer(settings.period, self._beat)
        self.create_timer(DIAGNOSTICS_SECONDS, self._diagnose)
        self._connecting = Connecting(settings, mapping, lambda: self._acting.target_return)

    def _declare(self, parameter: Parameter) -> object:
        default = rclpy.Parameter.Type.DOUBLE_ARRAY if isinstance(parameter.default, list) else parameter.default
        value = self.declare_parameter(parameter.name, default, describe(parameter)).value
        return [] if value is None else list(value) if isinstance(parameter.default, list) else value

    def close(self) -> None:
        """Tells the server the rest of the episode, and closes the session."""
        self._connecting.close()

    def _on_observation(self, message: Float32MultiArray) -> None:
        self._acting.observe_vector(message.data)

    def _on_joints(self, message: JointState) -> None:
        fields = {"position": message.position, "velocity": message.velocity, "effort": message.effort}
        self._acting.observe_joints(message.name, fields)

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._acting.end_episode(terminated=False)
        response.success, response.message = True, "the next observation begins an episode"
        return response

    def _on_end_episode(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._acting.end_episode(terminated=request.data)
        response.success, response.message = True, "the next observation begins an episode"
        return response

    def _on_parameters(self, parameters: Sequence[rclpy.Parameter]) -> SetParametersResult:
        try:
            for parameter in parameters:
                if parameter.name == "target_return":
                    self._acting.target_return = target_return(parameter.value)
        except ValueRefusedError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _beat(self) -> None:
        if (opened := self._connecting.take()) is not None:
            self._acting.begin(*opened)
        step = self._acting.beat()
        message = Float32MultiArray(data=step.command)
        size = len(step.command)
        message.layout.dim = [MultiArrayDimension(label=step.source, size=size, stride=size)]
        self._actions.publish(message)

    def _diagnose(self) -> None:
        acting = self._acting
        found = health(acting.beats, self._beats_before, acting.stats, self._connecting.error or acting.refusal)
        self._beats_before, acting.refusal = dict(acting.beats), ""
        status = DiagnosticStatus(
            level=bytes([found.level]),
            name=f"{self.get_fully_qualified_name()}: {self._settings.policy}",
            message=found.message,
            hardware_id=self._settings.server,
            values=[KeyValue(key=key, value=value) for key, value in found.values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)


def main() -> int:
    """Runs the node until SIGINT or SIGTERM. Returns 2 if a parameter or the mapping cannot be used."""
    logging.basicConfig(format="%(name)s: %(message)s")
    rclpy.init()
    try:
        node = ActingNode()
    except (ValueRefusedError, ParameterException) as error:
        print(f"spikeserve_ros: {error}", file=sys.stderr)
        return 2
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
