"""Makes the environments that `imitate` plays."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium

from spikeserve.check import check
from spikeserve.flat_spaces import FlatEnvironment

_AN_ID = "an id of Gymnasium, or `module:id` if a module registers it"
_FOR_PETTINGZOO = (
    "; for one of PettingZoo, write a gymnasium.Env whose step() plays one agent, with fixed "
    "policies for the others"
)


def load_object(path: str, field: str) -> Any:
    """Imports `module:name`. ValueError, which names `field`, if there is no such object."""
    module_name, separator, name = path.partition(":")
    check(bool(separator and module_name and name), field, "module:name", path)
    try:
        return getattr(importlib.import_module(module_name), name)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"{field}: expected an importable module:name, received {path}: {error}"
        ) from error


def name_of(value: Callable[..., Any]) -> str:
    """Returns module:name of a callable; of an instance, its type."""
    return f"{getattr(value, '__module__', '')}:{getattr(value, '__qualname__', repr(type(value)))}"


def is_found_by_name(value: Callable[..., Any]) -> bool:
    """Returns whether `name_of` leads to `value`: not for a lambda, closure or instance."""
    module, _, name = name_of(value).partition(":")
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return found is value


class EnvironmentFactory:
    """Makes equal environments with the spaces of a policy.

    `env_id` is an id of Gymnasium, with `module:` before it if a module registers it. `wrappers`
    are classes or functions, applied in order.
    """

    def __init__(
        self,
        env_id: str,
        wrappers: Sequence[Callable[[Any], Any]] = (),
        max_episode_steps: int | None = None,
    ) -> None:
        if not isinstance(env_id, str):
            _check_single("the argument", env_id)
            check(False, "env_id", _AN_ID, f"an environment, {type(env_id).__name__}")
        self._env_id = env_id
        self._wrappers = list(wrappers)
        self._max_episode_steps = max_episode_steps
        # A policy plays only where it was trained, so the name includes the wrappers.
        names = [getattr(wrapper, "__name__", type(wrapper).__name__) for wrapper in self._wrappers]
        # The module that registers the environment is not a part of its id in Gymnasium.
        self.name = "-".join([env_id.rpartition(":")[2], *names])

    @property
    def policy_name(self) -> str:
        """Returns a name for a folder of policies: lunarlander for LunarLander-v3."""
        plain = re.sub(r"-v\d+", "", self.name).lower()
        return re.sub(r"[^a-z0-9]+", "-", plain).strip("-")

    def make(self) -> FlatEnvironment:
        """Makes one environment."""
        try:
            environment: Any = gymnasium.make(
                self._env_id, max_episode_steps=self._max_episode_steps
            )
        except TypeError:
            _check_single(self._env_id, _unchecked(self._env_id))
            raise
        except (gymnasium.error.Error, ImportError) as error:
            expected = _AN_ID + (_FOR_PETTINGZOO if "pettingzoo" in self._env_id.lower() else "")
            raise ValueError(
                f"env_id: expected {expected}, received {self._env_id}: {error}"
            ) from error
        for wrapper in self._wrappers:
            environment = wrapper(environment)
        _check_single(self._env_id, environment)
        return FlatEnvironment(environment)


def _unchecked(env_id: str) -> Any:
    """Makes an environment that gymnasium.make() refuses, after it has imported the module."""
    spec = gymnasium.spec(env_id.rpartition(":")[2])
    assert spec.entry_point is not None
    create: Any = spec.entry_point
    if isinstance(create, str):
        create = gymnasium.envs.registration.load_env_creator(create)
    return create(**spec.kwargs)


def _check_single(env_id: str, environment: Any) -> None:
    """ValueError, with what to do, unless the environment is one of Gymnasium with one agent."""
    expected = "an environment of Gymnasium with one agent"
    if hasattr(environment, "possible_agents"):  # of PettingZoo's AECEnv and ParallelEnv
        expected += _FOR_PETTINGZOO
    elif isinstance(environment, gymnasium.vector.VectorEnv):
        expected += ", not a vector of them: --environments says how many are played at once"
    received = f"{type(environment).__name__} from {env_id}"
    check(isinstance(environment, gymnasium.Env), "env_id", expected, received)
