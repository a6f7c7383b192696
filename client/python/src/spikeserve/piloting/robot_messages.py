"""Converts between the robot's state machine, core/robot, and what Python's callers and gRPC have.

The machine is the compiled module `spikeserve._robot`, which a package without a compiler lacks.
"""

from __future__ import annotations

import importlib
from typing import Any

import grpc
import numpy as np
from numpy.typing import NDArray

from spikeserve.check import unmasked
from spikeserve.errors import (
    SpikeserveError,
    error_of_item,
    expected_decision,
    expected_episode,
    make_error,
)
from spikeserve.executed import Executed
from spikeserve.feature_order import FeatureOrder
from spikeserve.spaces import ActionSpace, Box
from spikeserve.wire import Message

robot: Any
try:
    robot = importlib.import_module("spikeserve._robot")
except ImportError:
    robot = None

_FAILURES = {
    grpc.StatusCode.NOT_FOUND: "NOT_FOUND",
    grpc.StatusCode.FAILED_PRECONDITION: "CONFLICT",
    grpc.StatusCode.DATA_LOSS: "CONFLICT",
    grpc.StatusCode.INVALID_ARGUMENT: "INVALID",
    grpc.StatusCode.UNAVAILABLE: "AWAY",
    grpc.StatusCode.DEADLINE_EXCEEDED: "AWAY",
}
_SAME = FeatureOrder()


def require_robot() -> None:
    """Raises ImportError if the package was installed without the machine."""
    if robot is None:
        raise ImportError(
            "Pilot: expected the compiled module spikeserve._robot, received none. Install the "
            "wheel of spikeserve for this Python, or a C++20 compiler and the headers of Python "
            "(g++ and python3-dev), and then spikeserve again; pip -v shows why it was left out"
        )


def to_robot(
    action: Any, space: ActionSpace, order: FeatureOrder = _SAME
) -> int | NDArray[np.float32] | None:
    """Returns an action as the machine takes it; what is none as one that it refuses."""
    if isinstance(action, Executed):
        action = action.action
    if action is None:
        return None
    try:
        action = order.executed(unmasked(action, "action"))
        if isinstance(space, Box):
            array = np.asarray(action, np.float32, order="C")
            return array if array.ndim == 1 else np.empty(0, np.float32)
        given = np.asarray(action)
        index = int(given)
        return index if given.ndim == 0 and index == given and 0 <= index < space.n else -1
    except Exception:  # of an array of the caller
        return np.empty(0, np.float32) if isinstance(space, Box) else -1


def from_robot(action: int | bytearray) -> int | NDArray[np.float32]:
    """Returns an action of the machine, which the caller may change."""
    return action if isinstance(action, int) else np.frombuffer(action, np.float32)


def number_of(given: Any) -> float:
    """Returns a number; NaN in the place of anything else."""
    try:
        return float(given)
    except Exception:  # of an object of the caller
        return float("nan")


def observation_of(given: Any, size: int, order: FeatureOrder) -> tuple[NDArray[np.float32], str]:
    """Returns an observation in the policy's order, and what is wrong if it is no row of numbers.

    Its size and its numbers are not checked.
    """
    wrong = f"observation: expected {size} numbers, received {_named(given)}"
    try:
        values = order.observation(unmasked(given, "observation"))
    except Exception as error:  # of an array of the caller
        wrong = str(error) if isinstance(error, ValueError) else wrong
        return np.empty(0, np.float32), wrong
    try:
        array = np.asarray(values, np.float32, order="C")
    except Exception:
        return np.empty(0, np.float32), wrong
    return (array, "") if array.ndim == 1 else (np.empty(0, np.float32), wrong)


def _named(given: Any) -> str:
    shape = getattr(given, "shape", None)
    return f"{type(given).__name__}" if shape is None else f"shape {shape}"


def error_to_robot(error: Exception) -> Any:
    """Returns what an error means for the session."""
    if not isinstance(error, SpikeserveError):
        return robot.Error(robot.Failure.OTHER, str(error), str(error))
    kind = getattr(robot.Failure, _FAILURES.get(error.code, "OTHER"))
    place = expected_decision(error), expected_episode(error)
    return robot.Error(kind, error.message, str(error), *place, error.retry_after)


def take_reply(
    machine: Any, reply: Message, now: int, robot_now: int, datagram: int | None = None
) -> tuple[Any, bool]:
    """Passes on a reply of the stream, or to the request of a datagram's number.

    Returns the episode that has ended or None, and whether there is work.
    """
    error = action = None
    if reply.HasField("error"):
        error = error_to_robot(error_of_item("ActStream", reply.error))
    if reply.HasField("action"):
        is_index = reply.action.WhichOneof("kind") == "discrete"
        values = reply.action.continuous.values
        action = reply.action.discrete if is_index else np.array(values, np.float32)
    result: tuple[Any, bool] = machine.on_reply(
        datagram,
        error,
        reply.next_step,
        action,
        (reply.source.kind, reply.source.operator_id),
        reply.observed_at,
        reply.wiring.is_safe_action or reply.HasField("hold"),
        reply.durable_decision,
        reply.durable_episode,
        reply.HasField("ended"),
        return_of(reply.ended),
        now,
        robot_now,
    )
    return result


def return_of(ended: Message) -> float | None:
    """Returns the return of an episode, or None if the server has repeated the steps alone.

    What a server decides costs energy.
    """
    return ended.episode_return if ended.energy_joules else None


def lost_episode(reason: str) -> SpikeserveError:
    """Returns the error of an episode whose end the server has not learned."""
    return make_error("EndEpisode", grpc.StatusCode.UNAVAILABLE, reason)
