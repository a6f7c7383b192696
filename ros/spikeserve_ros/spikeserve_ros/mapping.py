"""Makes observations of messages, and messages of actions.

A mapping file shows which field of which joint is each element of the observation, and which numbers each action of a
policy with discrete actions is:

    observation:
      - {joint: slider, field: position}
      - {joint: hinge, field: position, function: sin, scale: 1.0, offset: 0.0, name: pole_angle_sin}
    actions: [[-10.0], [10.0]]

An element is `function(value) * scale + offset`. If all of them have the names of the policy's elements, they may have any
order. A policy whose elements have names such as `hinge/position` needs no mapping of the observation. Immutable; safe to use from many threads.
"""

import dataclasses
import math
import numbers
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import yaml

from spikeserve_ros.errors import ValueRefusedError

FIELDS = ("position", "velocity", "effort")
FUNCTIONS: dict[str, Callable[[float], float]] = {"none": float, "cos": math.cos, "sin": math.sin}


def check_finite(field: str, values: Sequence[float]) -> list[float]:
    """Returns the values as floats. Raises ValueRefusedError for the first one that is not finite."""
    for i, value in enumerate(values):
        if not math.isfinite(value):
            raise ValueRefusedError(f"{field}[{i}]", "a finite number", value)
    return [float(value) for value in values]


def vector(field: str, values: Sequence[float], size: int) -> list[float]:
    """Returns an observation of `size` elements. Raises ValueRefusedError for another size or a value that is not finite."""
    if len(values) != size:
        raise ValueRefusedError(field, f"{size} elements", len(values))
    return check_finite(field, values)


@dataclasses.dataclass(frozen=True)
class Element:
    """One element of an observation, made from a joint."""

    joint: str
    field: str
    function: str = "none"
    scale: float = 1.0
    offset: float = 0.0
    name: str = ""  # of the policy's element; empty: the order says it


def _number(field: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, numbers.Real) or not math.isfinite(value):
        raise ValueRefusedError(field, "a finite number", value)
    return float(value)


def _element(field: str, given: Any) -> Element:
    if not isinstance(given, Mapping):
        raise ValueRefusedError(field, "joint and field", given)
    known = [each.name for each in dataclasses.fields(Element)]
    for name in given:
        if name not in known:
            raise ValueRefusedError(f"{field}.{name}", " or ".join(known), name)
    joint = given.get("joint")
    if not isinstance(joint, str) or not joint:
        raise ValueRefusedError(f"{field}.joint", "the name of a joint", joint)
    if given.get("field") not in FIELDS:
        raise ValueRefusedError(f"{field}.field", " or ".join(FIELDS), given.get("field"))
    if given.get("function", "none") not in tuple(FUNCTIONS):
        raise ValueRefusedError(f"{field}.function", " or ".join(FUNCTIONS), given["function"])
    return Element(
        joint,
        given["field"],
        given.get("function", "none"),
        _number(f"{field}.scale", given.get("scale", 1.0)),
        _number(f"{field}.offset", given.get("offset", 0.0)),
        str(given.get("name", "")),
    )


def elements_of(names: Sequence[str]) -> tuple[Element, ...]:
    """Returns the elements that the names JOINT/FIELD of a policy mean. Raises ValueRefusedError for other names."""
    elements = []
    for i, name in enumerate(names):
        joint, _, field = name.rpartition("/")
        if not joint or field not in FIELDS:
            expected = f"JOINT/FIELD with a field of {', '.join(FIELDS)}, or a mapping"
            raise ValueRefusedError(f"the policy's element {i}", expected, name)
        elements.append(Element(joint, field, name=name))
    return tuple(elements)


def _vectors(field: str, given: Any) -> tuple[tuple[float, ...], ...]:
    if not isinstance(given, list) or not given:
        raise ValueRefusedError(field, "a list of vectors, one for each action", given)
    vectors = []
    for i, row in enumerate(given):
        if not isinstance(row, list) or not row or len(row) != len(given[0]):
            raise ValueRefusedError(f"{field}[{i}]", "a vector as long as the first", row)
        vectors.append(tuple(_number(f"{field}[{i}][{j}]", value) for j, value in enumerate(row)))
    return tuple(vectors)


class Joints:
    """The last number of each field of each joint. Several publishers may share the topic, each with joints of its own."""

    def __init__(self) -> None:
        self._numbers: dict[tuple[str, str], tuple[float, float]] = {}  # by joint and field: the number and its time

    def update(self, names: Sequence[str], fields: Mapping[str, Sequence[float]], now: float) -> None:
        """Keeps the numbers of a JointState. Raises ValueRefusedError, and keeps none, if they do not fit the names.

        `fields` has position, velocity and effort, each empty or as long as `names`.
        """
        if len(set(names)) != len(names):
            raise ValueRefusedError("name", "distinct joints", list(names))
        for field in FIELDS:
            if len(fields[field]) not in (0, len(names)):
                raise ValueRefusedError(field, f"{len(names)} elements", len(fields[field]))
        for field in FIELDS:
            self._numbers.update({(name, field): (value, now) for name, value in zip(names, fields[field])})

    def value(self, joint: str, field: str) -> float:
        """Returns the last number of a joint. Raises ValueRefusedError if there is none."""
        if (joint, field) not in self._numbers:
            known = sorted(name for name, of in self._numbers if of == field)
            raise ValueRefusedError("name", f"the joint {joint} with its {field}", known)
        return self._numbers[joint, field][0]

    def time(self, joint: str, field: str) -> float:
        """Returns when the last number of a joint came. REQUIRES: there is one."""
        return self._numbers[joint, field][1]


@dataclasses.dataclass(frozen=True)
class RobotMapping:
    """What a mapping file says. Without elements observations are vectors already."""

    elements: tuple[Element, ...] = ()
    actions: tuple[tuple[float, ...], ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The policy's names of the elements; () unless all of them have one."""
        names = tuple(element.name for element in self.elements)
        return names if all(names) else ()

    @classmethod
    def parse(cls, given: Any) -> "RobotMapping":
        """Returns the mapping that YAML gave. Raises ValueRefusedError, which names the field."""
        if not isinstance(given, Mapping):
            raise ValueRefusedError("mapping", "observation and actions", given)
        for name in given:
            if name not in ("observation", "actions"):
                raise ValueRefusedError(name, "observation or actions", name)
        elements: tuple[Element, ...] = ()
        if "observation" in given:
            rows = given["observation"]
            if not isinstance(rows, list) or not rows:
                raise ValueRefusedError("observation", "a list of elements", rows)
            elements = tuple(_element(f"observation[{i}]", row) for i, row in enumerate(rows))
        return cls(elements, _vectors("actions", given["actions"]) if "actions" in given else ())

    @classmethod
    def read(cls, path: str) -> "RobotMapping":
        """Returns the mapping of a file. Raises ValueRefusedError, which names the file and the field."""
        try:
            given = yaml.safe_load(pathlib.Path(path).read_text())
        except (OSError, UnicodeError, yaml.YAMLError) as error:
            raise ValueRefusedError(path, "a YAML file", str(error)) from error
        try:
            return cls.parse(given)
        except ValueRefusedError as error:
            raise ValueRefusedError(f"{path}: {error.field}", error.expected, error.received) from None

    def observation(self, joints: "Joints") -> list[float]:
        """Returns the observation of the last numbers of all joints. Raises ValueRefusedError if one is missing."""
        observation = []
        for element in self.elements:
            value = FUNCTIONS[element.function](joints.value(element.joint, element.field))
            observation.append(value * element.scale + element.offset)
        return check_finite("observation", observation)

    def age(self, joints: "Joints", now: float) -> float:
        """Returns the seconds since the oldest number of an observation. REQUIRES: all of them are there."""
        return max((now - joints.time(each.joint, each.field) for each in self.elements), default=0.0)

    def command(self, action: int | Sequence[float]) -> list[float]:
        """Returns the numbers that are published for an action: those of the mapping, or the action itself."""
        if isinstance(action, numbers.Integral):
            if not self.actions:
                return [float(action)]
            if not 0 <= action < len(self.actions):
                raise ValueRefusedError("action", f"0 to {len(self.actions) - 1}", int(action))
            return list(self.actions[int(action)])
        return [float(value) for value in action]
