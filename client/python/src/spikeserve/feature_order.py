"""`FeatureOrder`: puts the elements of a robot in the order of the policy, by their names."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikeserve.check import check, unmasked
from spikeserve.executed import Executed

if TYPE_CHECKING:
    from spikeserve.values import ActionLike, Decision, ExecutedLike, Opening

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class FeatureOrder:
    """The order of one robot. Immutable. The default is the order of a policy without names.

    `taken[i]` is the element of the robot that is element i of the policy; None: the same order.
    """

    names: tuple[str, ...] = ()  # of the policy's observation; (): unknown
    taken: Indices | None = None
    taken_actions: Indices | None = None

    @classmethod
    def of(
        cls, opening: Opening, observation: Sequence[str] = (), action: Sequence[str] = ()
    ) -> FeatureOrder:
        """Returns the order of a robot that names its elements; (): it has the order of the policy.

        The server has checked that the names are those of the policy.
        """
        names = tuple(feature.name for feature in opening.observation_features)
        actions = tuple(feature.name for feature in opening.action_features)
        return cls(names, _taken(names, observation), _taken(actions, action))

    def observation(self, observation: Any) -> Any:
        """Returns an observation in the policy's order. ValueError if a Dict has other names.

        The elements of a Dict are named as in `named_elements`.
        """
        if isinstance(observation, Mapping):
            return self._by_name(observation)
        if self.taken is None or np.shape(observation) != self.taken.shape:
            return observation  # what checks the shape names it
        return np.asarray(unmasked(observation, "observation"), np.float32)[self.taken]

    def executed(self, action: ExecutedLike | None) -> Any:
        """Returns an executed action of the robot as one of the policy."""
        if isinstance(action, Executed):
            return replace(action, action=self.executed(action.action))
        taken = self.taken_actions
        if action is None or taken is None:
            return action
        given = np.asarray(unmasked(action, "executed_action"))
        if given.ndim == 0:
            found = np.flatnonzero(taken == given)
            return found[0].astype(given.dtype) if found.size else action  # others check the type
        return given.astype(np.float32)[taken] if given.shape == taken.shape else action

    def action(self, action: Any) -> Any:
        """Returns an action of the policy as one of the robot."""
        taken = self.taken_actions
        if taken is None:
            return action
        return int(taken[action]) if np.ndim(action) == 0 else self._back(action)

    def decision(self, decision: Decision) -> Decision:
        """Returns a decision with its action and its probabilities in the robot's order."""
        if self.taken_actions is None:
            return decision
        probabilities = decision.action_probabilities
        return replace(
            decision,
            action=self.action(decision.action),
            action_probabilities=None if probabilities is None else self._back(probabilities),
        )

    def around(
        self, fallback: Callable[[NDArray[np.float32]], ActionLike]
    ) -> Callable[[NDArray[np.float32]], Any]:
        """Returns a robot's function of observations as one of the policy's observations."""

        def ordered(observation: NDArray[np.float32]) -> Any:
            if self.taken is not None:
                robot = np.empty_like(observation)
                robot[self.taken] = observation
                observation = robot
            return self.executed(fallback(observation))

        return ordered

    def _back(self, values: ArrayLike) -> NDArray[np.float32]:
        result = np.empty(len(np.asarray(values)), np.float32)
        result[self.taken_actions] = values
        return result

    def _by_name(self, observation: Mapping[str, Any]) -> Any:
        elements = named_elements(observation)
        if not elements.keys() & set(self.names):
            return observation  # a dict of arrays, which what checks the shape refuses
        for name in self.names:
            check(name in elements, "observation", f"an element {name!r}", f"only {list(elements)}")
        for name in elements:
            check(name in self.names, "observation", f"only {list(self.names)}", repr(name))
        return np.array([elements[name] for name in self.names], np.float32)


def named_elements(observation: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """Returns the numbers of a Dict by name: "arm" for one number, "arm[0]" within an array.

    The keys of a Dict in a Dict are joined by "/", as in `flat_spaces.element_names`.
    """
    elements: dict[str, float] = {}
    for key, value in observation.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            elements.update(named_elements(value, f"{name}/"))
            continue
        numbers = np.asarray(unmasked(value, f"observation[{name!r}]"), np.float32).ravel()
        names = [name] if numbers.size == 1 else [f"{name}[{i}]" for i in range(numbers.size)]
        elements.update(zip(names, numbers.tolist(), strict=True))
    return elements


def _taken(policy: Sequence[str], robot: Sequence[str]) -> Indices | None:
    """Returns the robot's index of each name of the policy; None: the orders are equal."""
    names = list(robot)
    if not names or names == list(policy):
        return None
    return np.array([names.index(name) for name in policy], np.int64)
