"""The settings of `imitate`."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

from spikeserve.check import check
from spikeserve.imitation.delays import Delays, parse_delay
from spikeserve.model_config import ModelConfig

# Environment seeds: those below are for data, those from the second on for the final figures.
FIRST_SELECTION_SEED = 1_000_000
FIRST_UNSEEN_SEED = 2_000_000

GRADES = ("bad", "weak", "good")  # of a verdict

_SILENCE = ((6.0, 25.0), (3.0, 15.0), (1.5, 9.0))

# Flags of `spiketrain train` that cannot be in train_flags, which every stage receives.
_SET_BY_STAGES = (
    *("data", "out", "init", "resume", "overwrite", "seed", "seeds", "iterations"),
    *("target_rate", "readout_rate"),
)
# Only for a policy without --init.
_OWN_SETTINGS = ("lookback", "mirror", "image_shape", "patch_size")
# Refused by a training that continues from the policy of an earlier stage.
_FOR_ONE_STAGE = ("activity_router", "norm")

# The settings that are chosen where they are None, and their types.
CHOSEN: dict[str, type[int] | type[float]] = {
    "steps": int,
    "burst_rate": float,
    "longest_burst": int,
    "round_steps": int,
    "context": int,
    "clip_steps": int,
    "action_noise": float,
    "learning_rate": float,
    "iterations": int,
    "round_iterations": int,
    "silence_iterations": int,
}


def _setting(default: Any, text: str) -> Any:
    return field(default=default, metadata={"help": text})


_AT_LEAST_ONE = (
    "environments",
    "steps",
    "longest_burst",
    "hidden_size",
    "layers",
    "ticks",
    "context",
    "batch",
    "iterations",
    "seeds",
    "threads",
    "round_steps",
    "round_iterations",
    "silence_iterations",
    "selection_episodes",
    "episodes",
)


@dataclass(frozen=True)
class ImitationOptions:
    """How `imitate` records, trains and evaluates.

    A setting that is None is chosen by how the expert plays and by the recorded data. A run prints
    what it has chosen and why.
    """

    seed: int = _setting(0, "seed of every random draw")
    environments: int = _setting(16, "environments that are played at the same time")
    max_episode_steps: int | None = _setting(None, "longest episode; default: the environment's")
    delay: str | int | tuple[int, int] = _setting(
        0,
        "steps between an observation and the effect of its decision: a number like 3, or a range "
        "like 0..5, from which each episode draws one",
    )

    steps: int | None = _setting(None, "steps of the expert to record")
    disturbed: float = _setting(0.8, "share of its episodes with bursts of random actions")
    burst_rate: float | None = _setting(None, "largest probability that a burst begins at a step")
    longest_burst: int | None = _setting(None, "most steps of a burst")
    held_bursts: float = _setting(0.5, "share of the bursts that hold one random action")

    mode: str = _setting("baseline", "attention of the policy: baseline, pos, route, full or dense")
    hidden_size: int = _setting(64, "hidden size d of the policy")
    layers: int = _setting(2, "layers of the policy")
    ticks: int = _setting(8, "ticks of a token")
    context: int | None = _setting(None, "timesteps that the policy remembers")
    lookback: int | None = _setting(
        None,
        "timesteps back at which attention looks first, if the action depends on that observation; "
        "needs --mode=pos or full",
    )
    mirror: int | None = _setting(
        None,
        "timestep before which attention looks at first, as far as the present one is after it; "
        "needs --mode=pos or full",
    )
    clip_steps: int | None = _setting(None, "timesteps of a training clip; 0: the whole context")
    batch: int = _setting(64, "clips of an iteration")
    action_noise: float | None = _setting(
        None,
        "share of the policy's past actions replaced by random ones in training, so that it does "
        "not learn to repeat them; 0 where past actions are its memory",
    )
    learning_rate: float | None = _setting(None, "peak learning rate")
    iterations: int | None = _setting(None, "iterations of the first training")
    seeds: int = _setting(
        1, "first trainings, from other random weights each; the one with the best return is kept"
    )
    patch_size: int | None = _setting(
        None,
        "side in pixels of the patches of an image, which share an embedding; 0: none; default: by "
        "the image",
    )
    train_flags: tuple[str, ...] = _setting(
        ("--slope=4",), "more flags of `spiketrain train`, in one string"
    )
    threads: int = _setting(1, "threads of a training; the last bits of the weights depend on it")

    rounds: int = _setting(3, "rounds in which the policy plays and the expert labels its states")
    round_disturbed: float = _setting(0.5, "share of a round's episodes with bursts")
    round_steps: int | None = _setting(None, "steps of a round")
    round_iterations: int | None = _setting(None, "iterations of the training after a round")
    patience: int = _setting(
        0, "rounds without a better return after which the rounds end; 0: never"
    )

    silence: tuple[tuple[float, float], ...] = _setting(
        _SILENCE, "target firing rates of the steps to silence, in percent: HIDDEN:READOUT,..."
    )
    silence_iterations: int | None = _setting(None, "iterations of a step to silence")
    tolerance: float = _setting(
        0.005, "largest loss of return by silence, as a share of the distance from random to expert"
    )

    selection_episodes: int = _setting(100, "episodes of an evaluation between trainings")
    episodes: int = _setting(300, "episodes of the final evaluation, on unseen starts")

    @property
    def delays(self) -> Delays:
        """Returns the range of `delay`."""
        return Delays(*parse_delay(self.delay))

    def __post_init__(self) -> None:
        parse_delay(self.delay)
        for name in _AT_LEAST_ONE:
            value = getattr(self, name)
            check(value is None or value >= 1, name, "at least 1", value)
        for name in ("seed", "clip_steps", "rounds", "patience", "tolerance"):
            value = getattr(self, name)
            check(value is None or value >= 0, name, "at least 0", value)
        if self.patch_size is not None:
            check(self.patch_size >= 0, "patch_size", "at least 0", self.patch_size)
        if self.lookback is not None:
            check(self.lookback >= 1, "lookback", "at least 1", self.lookback)
            if self.context is not None:
                below = f"1 to {self.context - 1}, below the context"
                check(self.lookback < self.context, "lookback", below, self.lookback)
            check(self.mode in ("pos", "full"), "mode", "pos or full beside lookback", self.mode)
        if self.mirror is not None:
            check(self.lookback is None, "mirror", "none beside lookback", self.mirror)
            check(self.mirror >= 1, "mirror", "at least 1", self.mirror)
            if self.context is not None:
                below = f"1 to {(self.context - 1) // 2}, less than half of the context"
                check(2 * self.mirror < self.context, "mirror", below, self.mirror)
            check(self.mode in ("pos", "full"), "mode", "pos or full beside mirror", self.mode)
        check(self.rounds <= 10, "rounds", "at most 10", self.rounds)
        for name in ("disturbed", "burst_rate", "held_bursts", "action_noise", "round_disturbed"):
            value = getattr(self, name)
            check(value is None or 0 <= value <= 1, name, "a share from 0 to 1", value)
        check(
            self.learning_rate is None or self.learning_rate > 0,
            "learning_rate",
            "a number above 0",
            self.learning_rate,
        )
        for rates in self.silence:
            check(
                len(rates) == 2 and all(0 <= rate <= 100 for rate in rates),
                "silence",
                "pairs HIDDEN:READOUT of percentages from 0 to 100",
                ":".join(f"{rate:g}" for rate in rates),
            )
        silenced = bool(self.silence) and self.mode != "dense"
        check(
            self.selection_episodes >= 2 or not silenced,
            "selection_episodes",
            "at least 2 beside silence, because one start cannot tell what it costs",
            self.selection_episodes,
        )
        for flag in self.train_flags:
            _check_train_flag(flag, continues=self.rounds > 0 or silenced)
        self._check_shape()

    def _check_shape(self) -> None:
        """ValueError for a shape that no policy can have."""
        names = ("mode", "hidden_size", "layers", "ticks", "context")
        shape = {name: getattr(self, name) for name in names}
        if heads := re.search(r"--heads[= ](\d+)", " ".join(self.train_flags)):
            shape["heads"] = int(heads[1])
        ModelConfig(**{name: value for name, value in shape.items() if value is not None})


def _check_train_flag(flag: str, continues: bool) -> None:
    """ValueError for a flag with which a later stage would fail, or the stages would be alike.

    `continues` says whether a stage continues from the policy of an earlier one.
    """
    name = flag.removeprefix("--").partition("=")[0] if flag.startswith("--") else ""
    check(
        name != "arithmetic",
        "train_flags",
        "no --arithmetic, because stages continue from float32 weights, and version 2 of the "
        "policy is in integers",
        flag,
    )
    check(name not in _SET_BY_STAGES, "train_flags", f"no --{name}, which each stage sets", flag)
    check(
        name not in _FOR_ONE_STAGE or not continues,
        "train_flags",
        f"no --{name} beside rounds or silence, whose trainings refuse it",
        flag,
    )
    check(
        name not in _OWN_SETTINGS,
        "train_flags",
        f"no --{name}; lookback, mirror and patch_size are settings of imitate",
        flag,
    )
