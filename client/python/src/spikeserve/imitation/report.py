"""The one-page report of a run."""

from __future__ import annotations

import json
import pathlib
import statistics
from typing import Any, Protocol

from spikeserve.imitation.figures import Figures
from spikeserve.imitation.journal import Journal


class _Result(Protocol):
    @property
    def policies(self) -> pathlib.Path: ...
    @property
    def figures(self) -> Figures: ...
    @property
    def quantized_figures(self) -> Figures: ...
    @property
    def expert_figures(self) -> Figures: ...


def write_report(
    path: pathlib.Path,
    journal: Journal,
    name: str,
    chosen: str,
    stages: dict[str, Figures],
    result: _Result,
) -> None:
    """Writes the report, and beside it metadata.json with the same figures and all settings."""
    settings = json.loads((journal.folder / "settings.json").read_text())
    figures = {
        "expert": result.expert_figures,
        f"{name}/1, float32": result.figures,
        f"{name}/2, 8-bit weights": result.quantized_figures,
    }
    metadata = {
        "settings": settings,
        "chosen_stage": chosen,
        "figures": {title: value.to_json() for title, value in figures.items()},
        "stages": {stage: value.to_json() for stage, value in stages.items()},
    }
    path.with_name("metadata.json").write_text(json.dumps(metadata, indent=2) + "\n")
    lines = [
        f"# {settings['environment']}, imitating {settings['expert']}",
        "",
        f"Starts: {len(result.figures.returns)} that neither training nor selection used "
        f"(environment seeds from {result.figures.first_seed} on).",
        "",
        *_table(("", "return", "spikes per decision"), [_row(*item) for item in figures.items()]),
        "",
        "## Stages",
        "",
        f"Every stage played the same {len(stages[chosen].returns)} other starts. The policy is "
        f"that of `{chosen}`: the last stage whose return holds.",
        "",
        *_table(
            ("stage", "return", "spikes per decision", "seconds of training"),
            [
                (*_row(f"`{stage}`", value), _seconds(journal, stage))
                for stage, value in stages.items()
            ],
        ),
        *_seeds(stages),
        "",
        "## Serve it",
        "",
        "```",
        f"spikeserve --policies={result.policies}",
        "```",
        "",
        "## Settings",
        "",
        *_table(
            ("setting", "value"), [(f"`{key}`", f"`{value}`") for key, value in settings.items()]
        ),
    ]
    path.write_text("\n".join(lines) + "\n")


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
