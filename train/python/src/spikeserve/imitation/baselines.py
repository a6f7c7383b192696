"""Baselines beside a policy: a line and a perceptron that learned from the same data.

`spiketrain compare` fits them. This module plays them in the environment.
"""

from __future__ import annotations

import json
import pathlib
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from spikeserve.imitation.episodes import Choice, Row
from spikeserve.imitation.figures import Figures, standard_error

LARGEST_COMPARED = 128  # numbers of an observation; as in `spiketrain compare`


@dataclass(frozen=True)
class Baseline:
    """One fitted model; layers are (weight [out, in], bias [out]), with tanh between them."""

    name: str
    error: float
    frames: int
    mean: NDArray[np.float32]
    std: NDArray[np.float32]
    layers: list[tuple[NDArray[np.float32], NDArray[np.float32]]]

    def outputs(self, observations: list[NDArray[Any]]) -> NDArray[np.float32]:
        """Returns the outputs for the observations of an episode so far, newest last."""
        recent = [np.asarray(o, np.float32) for o in observations[-self.frames :]][::-1]
        recent += [recent[-1]] * (self.frames - len(recent))  # nothing has changed before the start
        changes = [newer - older for newer, older in pairwise(recent)]
        values = (np.concatenate([recent[0], *changes]) - self.mean) / self.std
        for index, (weight, bias) in enumerate(self.layers):
            values = weight @ (np.tanh(values) if index > 0 else values) + bias
        return np.asarray(values, np.float32)


@dataclass(frozen=True)
class Comparison:
    """What `spiketrain compare` wrote."""

    policy_error: float
    element_errors: list[float]  # of the policy, for each element of a Box; empty if Discrete
    explained: float  # the share of the actions that the policy explains
    explained_elements: dict[str, float]  # of each element of a Box, by name; empty if Discrete
    error_is: str
    warnings: list[str]
    baselines: list[Baseline]

    @property
    def errors(self) -> dict[str, float]:
        """Returns the errors of the policy, as "the policy", and of the baselines."""
        baselines = {baseline.name: baseline.error for baseline in self.baselines}
        return {"the policy": self.policy_error} | baselines

    @classmethod
    def read(cls, path: pathlib.Path) -> Comparison:
        """Reads the file of `compare --out`, or baselines.json of `train`, which has no verdict."""
        stored = json.loads(path.read_text())
        return cls(
            stored["policy"]["error"],
            stored["policy"].get("error_by_element", []),
            stored["policy"]["explained"],
            stored.get("verdict", {}).get("explained_by_element", {}),
            stored["error_is"],
            stored["warnings"],
            [_baseline(entry) for entry in stored["baselines"]],
        )


def _baseline(entry: dict[str, Any]) -> Baseline:
    def array(values: Any) -> NDArray[np.float32]:
        return np.asarray(values, np.float32)

    layers = [(array(layer["weight"]), array(layer["bias"])) for layer in entry["layers"]]
    return Baseline(
        entry["name"],
        entry["error"],
        entry["frames"],
        array(entry["mean"]),
        array(entry["std"]),
        layers,
    )


class BaselineActor:
    """Plays a baseline."""

    def __init__(self, baseline: Baseline) -> None:
        self._baseline = baseline

    def choose(self, rows: list[Row]) -> list[Choice]:
        """Returns the actions of the baseline."""
        return [self._choose(row) for row in rows]

    def end(self, row: Row) -> None:
        """Does nothing."""

    def _choose(self, row: Row) -> Choice:
        outputs = self._baseline.outputs(row.episode.observations)
        space = row.environment.actions.space
        if isinstance(space, spaces.Discrete):
            return Choice(int(np.argmax(outputs)))
        unit = (np.clip(outputs, -1, 1) + 1) / 2
        return Choice((space.low + unit * (space.high - space.low)).astype(np.float32))


def return_warnings(policy: Figures, baselines: dict[str, Figures]) -> list[str]:
    """Returns a line for each baseline that returns more by over two standard errors."""
    lines = []
    for name, figures in baselines.items():
        count = min(len(policy.returns), len(figures.returns))
        gains = np.array(figures.returns[:count]) - np.array(policy.returns[:count])
        error = standard_error(gains)
        if gains.mean() > 2 * error:
            lines.append(
                f"{name} returns more than the policy on the same {count} starts: "
                f"by {gains.mean():.3g} ± {error:.2g}"
            )
    return lines
