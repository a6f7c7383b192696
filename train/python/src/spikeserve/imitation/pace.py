"""Chooses how the expert is recorded, by how it plays and recovers."""

from __future__ import annotations

from dataclasses import dataclass, replace

from spikeserve.imitation.actors import Bursts, ExpertActor
from spikeserve.imitation.experts import Expert
from spikeserve.imitation.figures import Evaluator
from spikeserve.imitation.options import ImitationOptions

# Rates and lengths of bursts, from the strongest on.
_STRENGTHS = ((0.3, 8), (0.2, 6), (0.1, 4), (0.05, 3), (0.02, 2), (0.02, 1))
_LONGEST = _STRENGTHS[0][1]
_KEPT = 0.5  # share of the way from random actions to the expert that a disturbed expert keeps
_EPISODES = 200  # of the expert, as far as the bounds of the steps allow
_FEWEST_STEPS, _MOST_STEPS = 30_000, 60_000
_FIRST_SEED = 900_000  # starts of neither data nor evaluations


@dataclass(frozen=True)
class RecordingPlan:
    """The settings of the recordings, and why."""

    steps: int
    burst_rate: float
    longest_burst: int
    round_steps: int
    reasons: list[str]


def plan_recording(
    options: ImitationOptions, expert: Expert | None, evaluator: Evaluator
) -> RecordingPlan:
    """Returns the settings of `options`; those that are None, by what the expert shows.

    Plays a few episodes of the expert, with bursts of random actions of several strengths, unless
    all settings are given or there is no expert to ask.
    """
    given = options.steps, options.burst_rate, options.longest_burst, options.round_steps
    reasons: list[str] = []
    steps, rate, longest, round_steps = given
    if None in given and expert is not None:
        length = _length(evaluator, expert)
        if steps is None:
            steps = min(max(_EPISODES * length, _FEWEST_STEPS), _MOST_STEPS)
            reasons.append(
                f"steps = {steps}: an episode of the expert has {length} steps, and about "
                f"{steps // length} of them show many starts"
            )
        if rate is None or longest is None:
            most = Bursts(
                seed=0,
                disturbed=1.0,
                rate=1.0 if rate is None else rate,
                longest=_LONGEST if longest is None else longest,
                held=options.held_bursts,
            )
            rate, longest, kept = _strongest(evaluator, expert, most)
            reasons.append(
                f"burst_rate = {rate:g}, longest_burst = {longest}: with bursts of random actions "
                f"of this strength the expert still comes {kept:.0%} of the way from random "
                "actions to what it returns without them"
            )
    steps = steps or _MOST_STEPS
    if round_steps is None:
        round_steps = max(1, steps // 3)
        reasons.append(f"round_steps = {round_steps}: a third of the steps")
    return RecordingPlan(
        steps,
        _STRENGTHS[0][0] if rate is None else rate,
        _LONGEST if longest is None else longest,
        round_steps,
        reasons,
    )


def _length(evaluator: Evaluator, expert: Expert) -> int:
    figures = evaluator.evaluate(
        ExpertActor(expert), _FIRST_SEED, evaluator.environments, "the expert's pace"
    )
    return max(1, round(figures.decisions / len(figures.returns)))


def _strongest(evaluator: Evaluator, expert: Expert, most: Bursts) -> tuple[float, int, float]:
    """Returns the strongest bursts from which the expert recovers, and the share that it keeps.

    They are like `most`, with at most its rate and its length.
    """
    episodes = evaluator.environments
    chance = evaluator.evaluate_chance(_FIRST_SEED, episodes).mean
    alone = evaluator.evaluate(ExpertActor(expert), _FIRST_SEED, episodes, "expert plays").mean
    rate, longest, kept = 0.0, 1, 1.0
    for strength in _STRENGTHS:
        rate, longest = min(strength[0], most.rate), min(strength[1], most.longest)
        actor = ExpertActor(expert, replace(most, rate=rate, longest=longest))
        disturbed = evaluator.evaluate(actor, _FIRST_SEED, episodes, f"bursts of {longest} steps")
        kept = (disturbed.mean - chance) / ((alone - chance) or 1.0)
        if kept >= _KEPT:
            break
    return rate, longest, kept
