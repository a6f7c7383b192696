"""The one-page report of a run."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import statistics
from dataclasses import dataclass
from typing import Any

import safetensors

from spikeserve.imitation.delays import AT_ONCE, Delays
from spikeserve.imitation.figures import Figures
from spikeserve.imitation.insight import Insight, Verdict
from spikeserve.imitation.journal import Journal


@dataclass(frozen=True)
class ImitationResult:
    """The outcome of `imitate`. The figures are of starts that nothing else used."""

    policies: pathlib.Path  # a folder for `spikeserve --policies`
    policy: pathlib.Path  # the policy in float32
    quantized: pathlib.Path | None  # in integers; None in mode dense, or if it lost too much
    report: pathlib.Path
    figures: Figures  # of `policy`
    quantized_figures: Figures | None
    baselines: dict[str, Figures]  # of lines and perceptrons that learned from the same data
    warnings: list[str]  # of baselines that are better than the policy, and of lost returns
    expert_figures: Figures
    errors: dict[str, float]  # on held-out episodes, of "the policy" and of the baselines
    verdict: Verdict
    advice: list[str]  # what to try next


@dataclass(frozen=True)
class Account:
    """How a run went."""

    journal: Journal
    settings: dict[str, Any]
    reasons: list[str]  # of the settings that were chosen
    name: str  # of the policy
    chosen: str  # the stage whose policy it is
    stages: dict[str, Figures]
    delays: Delays = AT_ONCE


def write_report(
    path: pathlib.Path, account: Account, result: ImitationResult, insight: Insight
) -> None:
    """Writes the report, and beside it metadata.json with the same figures and all settings."""
    name, settings, stages = account.name, account.settings, account.stages
    figures = {
        "expert": result.expert_figures,
        f"{name}/1, float32": result.figures,
    }
    if result.quantized_figures is not None:
        figures[f"{name}/2, integers"] = result.quantized_figures
    metadata: dict[str, Any] = {
        "settings": settings,
        "reasons": account.reasons,
        "chosen_stage": account.chosen,
        "figures": {title: value.to_json() for title, value in figures.items()},
        "random_actions": insight.chance.to_json(),
        "stages": {stage: value.to_json() for stage, value in stages.items()},
        "baselines": {title: value.to_json() for title, value in result.baselines.items()},
        "warnings": result.warnings,
        "verdict": dataclasses.asdict(result.verdict),
        "advice": result.advice,
        "noise_floor": insight.floor,
        "drift": insight.drift,
        "share_of_the_way_to_the_expert": insight.share,
    }
    path.with_name("metadata.json").write_text(json.dumps(metadata, indent=2) + "\n")
    lines = [
        *_introduction(account, result, insight, figures),
        "## What to try next",
        "",
        *[f"- {line}" for line in metadata["advice"]],
        "",
        *_errors(insight),
        *_stages(account),
        "## Serve it",
        "",
        "```",
        f"spikeserve --policies={result.policies}",
        "```",
        "",
        "## Settings",
        "",
        *[f"- {reason}" for reason in account.reasons],
        *([""] if account.reasons else []),
        *_table(
            ("setting", "value"), [(f"`{key}`", f"`{value}`") for key, value in settings.items()]
        ),
    ]
    path.write_text("\n".join(lines) + "\n")


def _introduction(
    account: Account, result: ImitationResult, insight: Insight, figures: dict[str, Figures]
) -> list[str]:
    """Returns the returns of the policy, the expert and what it is compared with."""
    settings = account.settings
    return [
        f"# {settings['environment']}, imitating {settings['expert']}",
        "",
        f"Starts: {len(result.figures.returns)} that neither training nor selection used "
        f"(environment seeds from {result.figures.first_seed} on).",
        "",
        f"**Verdict: {result.verdict.grade}**: {result.verdict.reason}.",
        "",
        *_delays(account.delays),
        *_table(("", "return", "spikes per decision"), [_row(*item) for item in figures.items()]),
        "",
        f"Random actions return {insight.chance} on {len(insight.chance.returns)} other starts.",
        "",
        *_baselines(result, insight),
    ]


def _stages(account: Account) -> list[str]:
    """Returns the figures of each stage of the training."""
    stages, chosen = account.stages, account.chosen
    return [
        "## Stages",
        "",
        f"Every stage played the same {len(stages[chosen].returns)} other starts. The policy is "
        f"that of `{chosen}`: the last stage whose return holds.",
        "",
        *_table(
            ("stage", "return", "spikes per decision", "seconds of training"),
            [
                (*_row(f"`{stage}`", value), _seconds(account.journal, stage))
                for stage, value in stages.items()
            ],
        ),
        *_seeds(stages),
        "",
    ]


def _delays(delays: Delays) -> list[str]:
    """Returns a sentence about the delays, if there are any."""
    if not delays:
        return []
    return [
        f"The policies play with {delays.least} to {delays.most} steps of delay, which the starts "
        "take in turn; the expert plays without.",
        "",
    ]


def has_changes(policy: pathlib.Path) -> bool:
    """Returns whether the state tokens of a policy contain the change of the observation."""
    with safetensors.safe_open(policy, framework="np") as file:
        return "observation.change_std" in file.keys()


def _baselines(result: ImitationResult, insight: Insight) -> list[str]:
    """Returns the section of the baselines, with a warning for each that is better."""
    comparison = insight.comparison
    if comparison is None:
        return []
    episodes = max(len(figures.returns) for figures in result.baselines.values())
    own = result.figures.of_the_first(episodes)
    rows = [("the policy", f"{comparison.policy_error:.4f}", str(own))]
    for baseline in comparison.baselines:
        figures = result.baselines[baseline.name]
        rows.append((baseline.name, f"{baseline.error:.4f}", str(figures)))
    return [
        "## Baselines",
        "",
        "Linear maps and perceptrons (two hidden layers of 32 or 64, three seeds) that learned "
        "from the same data, on the last 1, 2 or 4 observations. The error is the "
        f"{comparison.error_is}, on held-out episodes. All returns of this table are those of the "
        f"first {episodes} of the starts above.",
        "",
        *_table(("", "error", "return"), rows),
        "",
        *[f"**Warning:** {line}." for line in result.warnings],
        *([""] if result.warnings else []),
    ]


def _errors(insight: Insight) -> list[str]:
    """Returns the section that shows where the errors are."""
    lines = ["## Where the errors are", ""]
    if insight.floor is not None:
        lines += [
            f"The noise of the expert's own actions sets a floor of {insight.floor:.4f} to the "
            "error (it was asked twice in the same states).",
            "",
        ]
    if insight.comparison is not None and len(insight.comparison.element_errors) > 1:
        rows = [(str(i), f"{e:.4f}") for i, e in enumerate(insight.comparison.element_errors)]
        lines += [*_table(("element of the action", "error"), rows), ""]
    if insight.drift is not None:
        rows = [(f"{first} to {last}", f"{error:.4f}") for first, last, error in insight.drift]
        lines += [
            "In closed loop, against what the expert would do in the states that the policy "
            "reaches:",
            "",
            *_table(("steps", "error"), rows),
            "",
        ]
    if insight.curves:
        curve = [(str(i), f"{mean:.4f} ± {spread:.4f}") for i, mean, spread in insight.curves]
        lines += [
            "Validation loss of the first trainings, mean and deviation over their seeds:",
            "",
            *_table(("iteration", "validation loss"), curve),
            "",
        ]
    return lines


def _seeds(stages: dict[str, Figures]) -> list[str]:
    """Returns a sentence about the first trainings, if there are several."""
    means = [value.mean for stage, value in stages.items() if stage.endswith("-play")]
    if len(means) < 2:
        return []
    spread = statistics.stdev(means)
    return [
        "",
        f"{len(means)} first trainings differ only in their seeds. Mean and standard deviation of "
        f"their returns: {statistics.fmean(means):.3f} ± {spread:.3f}. The best one was continued.",
    ]


def _row(title: str, figures: Figures) -> tuple[str, str, str]:
    spikes = f"{figures.spikes_per_decision:.0f}" if figures.spikes else ""
    return title, str(figures), spikes


def _seconds(journal: Journal, stage: str) -> str:
    seconds = journal.part(f"stages/{stage}", dict).get("seconds", 0)
    return f"{seconds:.0f}"


def _table(header: tuple[str, ...], rows: list[Any]) -> list[str]:
    lines = ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    return lines + ["| " + " | ".join(row) + " |" for row in rows]
