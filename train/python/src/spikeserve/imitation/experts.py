"""Loads experts: callables, policies of Stable-Baselines3 and CleanRL, datasets of Minari."""

from __future__ import annotations

import inspect
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np

from spikeserve.check import check
from spikeserve.flat_spaces import FlatEnvironment
from spikeserve.imitation.cleanrl import SUFFIX, load_cleanrl
from spikeserve.imitation.environments import load_object

# Returns the expert's action, in the environment's own space, for its last observation.
Expert = Callable[[FlatEnvironment], Any]

_FORMS = (
    "module:function, ALGORITHM:FILE.zip of Stable-Baselines3, "
    "SCRIPT:FILE.cleanrl_model of CleanRL, or a Minari dataset"
)


def is_dataset(expert: Any) -> bool:
    """Returns whether `expert` names a dataset of Minari: its folder, or an id like name-v0."""
    if not isinstance(expert, str | pathlib.Path):
        return False
    folder = pathlib.Path(expert)
    return (folder / "data/metadata.json").is_file() or ":" not in str(expert)


def load_expert(expert: str | Callable[..., Any]) -> Expert:
    """Returns the expert that a callable or a name describes. ValueError if it cannot be used.

    A callable takes an observation, or an environment (without wrappers) and an observation, as
    Gymnasium's heuristics do.
    """
    if callable(expert):
        return _from_callable(expert)
    name, separator, rest = str(expert).partition(":")
    check(bool(separator), "expert", _FORMS, expert)
    if rest.endswith(".zip"):
        return _from_stable_baselines(name, rest)
    if rest.endswith(SUFFIX):
        return load_cleanrl(name, rest)
    loaded = load_object(str(expert), "expert")
    check(callable(loaded), "expert", "a callable", loaded)
    return _from_callable(loaded)


def _from_callable(function: Callable[..., Any]) -> Expert:
    required = [
        parameter
        for parameter in inspect.signature(function).parameters.values()
        if parameter.default is parameter.empty
        and parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
    ]
    expected = "a callable of (observation) or (environment, observation)"
    check(len(required) in (1, 2), "expert", expected, f"{len(required)} required parameters")
    if len(required) == 1:
        return lambda environment: function(environment.native_observation)
    return lambda environment: function(environment.unwrapped, environment.native_observation)


def _from_stable_baselines(algorithm: str, path: str) -> Expert:
    try:
        import stable_baselines3
    except ImportError as error:
        raise ValueError(
            f"expert: expected the package stable_baselines3 for {path}, received none"
        ) from error
    loader = getattr(stable_baselines3, algorithm, None)
    if loader is None:
        raise ValueError(
            f"expert: expected an algorithm of stable_baselines3, received {algorithm}"
        )
    check(pathlib.Path(path).is_file(), "expert", "a file of Stable-Baselines3", path)
    model = loader.load(path, device="cpu")

    def act(environment: FlatEnvironment) -> Any:
        action, _ = model.predict(environment.native_observation, deterministic=True)
        return np.asarray(action)

    return act
