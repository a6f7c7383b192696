"""The parameters of the node, with their ranges, and the settings that their values make.

Immutable; safe to use from many threads.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from spikeserve_ros.errors import ValueRefusedError

INPUTS = ("array", "joints")
TRANSPORTS = ("auto", "stream", "datagram")


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A parameter. Its type is that of its default. A fixed one is read at the start only."""

    name: str
    default: Any
    description: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    fixed: bool = True

    def check(self, value: Any) -> Any:
        """Returns the value. Raises ValueRefusedError if it has another type, is not finite or out of range."""
        kind = type(self.default)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if kind is list:
            if not isinstance(value, (list, tuple)) or not all(isinstance(each, (int, float)) for each in value):
                raise ValueRefusedError(self.name, "a list of numbers", value)
            value = [float(each) for each in value]
            if not all(map(math.isfinite, value)):
                raise ValueRefusedError(self.name, "finite numbers", value)
            return value
        if type(value) is not kind:
            raise ValueRefusedError(self.name, {float: "a number", int: "an integer", str: "a text"}[kind], value)
        if self.choices and value not in self.choices:
            raise ValueRefusedError(self.name, " or ".join(self.choices), value)
        if self.low is not None and not self.low <= value <= self.high:
            raise ValueRefusedError(self.name, f"{self.low} to {self.high}", value)
        return value


PARAMETERS = (
    Parameter("server", "127.0.0.1:50051", "Address of spikeserve, HOST:PORT; several with commas"),
    Parameter("policy", "cartpole", "Name of the policy"),
    Parameter("version", 0, "Version of the policy; 0: the default", 0, 2**31 - 1),
    Parameter("rate", 50.0, "Actions a second", 0.1, 1000.0),
    Parameter("input", "array", "array: Float32MultiArray; joints: JointState by the mapping", choices=INPUTS),
    Parameter("mapping", "", "YAML file that maps joints to observations and actions to numbers"),
    Parameter("safe_action", [], "What is published when there is neither an answer nor a fallback"),
    Parameter("observation_timeout", 0.5, "Age in seconds at which an observation is lost", 0.001, 60.0),
    Parameter("transport", "auto", "How steps go to the server; auto: as datagrams where it takes them", choices=TRANSPORTS),
    Parameter("redundancy", 1, "How often each datagram is sent", 1, 2),
    Parameter(
        "target_return",
        -1e9,
        "Return that the policy aims at, from the next episode on; -1e9: that of the policy file",
        -1e9,
        1e9,
        fixed=False,
    ),
)
BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}


@dataclasses.dataclass(frozen=True)
class Settings:
    """The values of all parameters."""

    server: str
    policy: str
    version: int
    rate: float
    input: str
    mapping: str
    safe_action: tuple[float, ...]
    observation_timeout: float
    transport: str
    redundancy: int
    target_return: float | None  # None: that of the policy file

    @property
    def period(self) -> float:
        """Seconds from one action to the next."""
        return 1.0 / self.rate

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> "Settings":
        """Returns the settings of the given values; the others are the defaults.

        Raises ValueRefusedError, which names the parameter.
        """
        for name in values:
            if name not in BY_NAME:
                raise ValueRefusedError(name, "a parameter", name)
        checked = {name: each.check(values.get(name, each.default)) for name, each in BY_NAME.items()}
        if not checked["safe_action"]:
            raise ValueRefusedError("safe_action", "the numbers of an action", checked["safe_action"])
        checked["safe_action"] = tuple(checked["safe_action"])
        checked["target_return"] = target_return(checked["target_return"])
        return cls(**checked)


def target_return(value: float) -> float | None:
    """Returns the target that a parameter means; its default means that of the policy file."""
    value = BY_NAME["target_return"].check(value)
    return None if value == BY_NAME["target_return"].default else value
