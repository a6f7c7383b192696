"""Writes the tables of the study into its page, from the tables of the runs.

    python lab/study/study_page.py lab/study/runs lab/evidence/study.md

A score is a return on a scale where random actions have 0 and the expert 100. Statements compare two arms by seed.
"""

import argparse
import collections
import dataclasses
import math
import pathlib
import sys

import numpy as np
import seed_statistics
import study_field
import study_integers
import study_parts
import study_plan
import study_settings
import study_structured
import study_tasks
from run_table import read_results, served
from study_tables import ALPHA, digits_of, energies_in, energy_cells, joined, mean_served, ranked_group, read_runs, row, score

MARGIN = 5.0  # points of the score: a smaller difference counts as none
# Mean scores between which both arms have room to differ: near chance and near the expert all arms are alike.
ROOM = (2 * MARGIN, 100 - 2 * MARGIN)
NEAR_LIMIT = (0.04, 0.06)  # p-values that another choice of the test moves across 0.05
SMALLEST_P = 1e-12  # the digits of smaller ones are rounding errors


@dataclasses.dataclass(frozen=True)
class Statement:
    """Holds if a measure of two arms lies above a bound, in the mean over seeds."""

    text: str
    first: str
    second: str
    measure: str = "score"  # or "halvings" of the loss
    bound: float = 0.0

    def values(self, results):
        """Returns the measure of every seed that both arms have. `results` are those of a task, by arm and seed."""
        seeds = sorted(results[self.first].keys() & results[self.second].keys())
        pairs = [(results[self.first][seed], results[self.second][seed]) for seed in seeds]
        if self.measure == "score":
            return [score(first) - score(second) for first, second in pairs]
        return [math.log2(second["validation_loss"] / first["validation_loss"]) for first, second in pairs]


STATEMENTS = (
    Statement(f"`full` returns at most {MARGIN:g} points less than `dense` (claim 7)", "full", "dense", bound=-MARGIN),
    Statement("`pos` returns more than `baseline` (4.2.4)", "pos", "baseline"),
    Statement("`route` returns more than `baseline` (4.3.4)", "route", "baseline"),
    Statement("`full` returns more than `baseline` (claim 9)", "full", "baseline"),
    Statement("`full` returns more than `pos` (claim 9)", "full", "pos"),
    Statement("`full` returns more than `route` (claim 9)", "full", "route"),
    Statement("`route` halves the loss of `baseline` (claim 6)", "route", "baseline", "halvings", 1.0),
    Statement("`full` returns more than trained with N = 1", "full", "full-n1"),
)


def results_of(folder):
    """Returns the results of the study by task, arm and seed."""
    runs = read_runs(folder, ranked_group(folder))
    return {task: {arm: runs.get((task, arm), {}) for arm in study_plan.ARMS} for task in study_tasks.TASKS}


def has_room(statement, results):
    """Returns whether the mean scores of both arms leave room for a difference."""
    means = [np.mean([score(run) for run in results[arm].values()]) for arm in (statement.first, statement.second)]
    return all(ROOM[0] <= mean <= ROOM[1] for mean in means)


@dataclasses.dataclass(frozen=True)
class Test:
    """A statement on one task. `difference` and `equal` are p-values, corrected for all statements; `room`: see has_room."""

    statement: Statement
    values: list[float]
    difference: float
    equal: float
    room: bool = True

    @property
    def verdict(self):
        above = np.mean(self.values) > self.statement.bound if self.values else False
        if self.difference < ALPHA:
            return "holds" if above else "does not hold"
        if not self.room and self.equal < ALPHA:
            return "cannot be told, no room"
        return "does not hold, equal" if self.equal < ALPHA else "cannot be told"

    def __str__(self):
        if not self.values:
            return "no run"
        if self.statement.measure == "halvings":
            value = f"{2 ** -np.mean(self.values):.2f} of it"
        else:
            value = f"{np.mean(self.values):+z.1f}"
        p_value = self.equal if self.verdict.endswith("equal") else self.difference
        near = ", near the limit" if NEAR_LIMIT[0] < p_value < NEAR_LIMIT[1] else ""
        p_text = f"p = {p_value:.2g}" if p_value >= SMALLEST_P else f"p < {SMALLEST_P:.0e}"
        return f"**{self.verdict}{near}**: {value}, {p_text}, {len(self.values)}"


def tests_of(results):
    """Returns the tests by statement and task. The p-values of all cells are corrected by Holm's method, and so are those of equality,
    for which only statements of a higher score are tested."""
    values = {(statement, task): statement.values(results[task]) for statement in STATEMENTS for task in results}
    differences, equals, rooms = {}, {}, {}
    for (statement, task), sample in values.items():
        enough, cell = len(sample) > 1, (statement, task)
        differences[cell] = seed_statistics.two_sided(sample, statement.bound) if enough else 1.0
        if statement.measure == "score" and statement.bound == 0:
            equals[cell] = seed_statistics.equivalence(sample, MARGIN) if enough else 1.0
            rooms[cell] = not enough or has_room(statement, results[task])
    differences, equals = (dict(zip(of, seed_statistics.holm(list(of.values())), strict=True)) for of in (differences, equals))
    return {
        cell: Test(cell[0], sample, differences[cell], equals.get(cell, 1.0), rooms.get(cell, True))
        for cell, sample in values.items()
    }


def verdict_table(results):
    tests = tests_of(results)
    yield row(["statement", *results])
    yield row(["---"] * (1 + len(results)))
    for statement in STATEMENTS:
        yield row([statement.text, *(str(tests[statement, task]) for task in results)])


def with_interval(groups, digits):
    """Returns an interquartile mean with its interval, or the mean of a single seed alone."""
    mean = seed_statistics.interquartile_mean(np.concatenate(groups))
    if min(len(group) for group in groups) < 2:
        return f"{mean:.{digits}f} (one seed)"
    return "{:.{d}f} ({:.{d}f} to {:.{d}f})".format(mean, *seed_statistics.bootstrap_interval(groups), d=digits)


def returns_table(results):
    energies = energies_in([run for arms in results.values() for seeds in arms.values() for run in seeds.values()])
    yield row(["task", "arm", "seeds", "return", "spikes", *energies, "learning rate"])
    yield row(["---", "---", *["---:"] * (4 + len(energies))])
    for task, arms in results.items():
        digits = digits_of(task)
        for arm, seeds in arms.items():
            if not seeds:
                continue
            runs = [seeds[seed] for seed in sorted(seeds)]
            yield row(
                [
                    *(task, f"`{arm}`", str(len(runs))),
                    with_interval([[served(run)["mean_return"] for run in runs]], digits),
                    mean_served(runs, "spikes_per_decision", 0),
                    *energy_cells(runs, energies),
                    ", ".join(sorted({run["learning_rate"] for run in runs})),
                ]
            )


def scores_table(results):
    """The score over all tasks, of seeds that every task and arm has; no table without such seeds."""
    seeds = set.intersection(*(set(runs) for arms in results.values() for runs in arms.values()))
    if not seeds:
        return
    yield row(["arm", "score over all tasks", "seeds"])
    yield row(["---", "---:", "---:"])
    for arm in study_plan.ARMS:
        groups = [[score(arms[arm][seed]) for seed in sorted(seeds)] for arms in results.values()]
        yield row([f"`{arm}`", with_interval(groups, 1), str(len(seeds))])


def sweep_table(folder):
    means = collections.defaultdict(lambda: collections.defaultdict(list))
    for result in read_results(folder, "sweep"):
        means[result["task"]][result["learning_rate"]].append(result["mean_return"])
    yield row(["return of `dense`, learning rate", *study_plan.RATES])
    yield row(["---"] + ["---:"] * len(study_plan.RATES))
    for task, rates in means.items():
        yield row(
            [task, *(f"{np.mean(rates[rate]):.3g} ({len(rates[rate])})" if rates[rate] else "" for rate in study_plan.RATES)]
        )


def tables(folder):
    """Returns the generated part of the page."""
    results = results_of(folder)
    counts = [len(seeds) for arms in results.values() for seeds in arms.values()]
    finished = (
        f"Finished: {sum(counts)} of {study_plan.SEEDS * len(counts)} runs, at least {min(counts)} and at most "
        f"{max(counts)} seeds of a task and arm."
    )
    parts = [[finished], verdict_table(results), scores_table(results), sweep_table(folder)]
    if sum(counts):
        parts.insert(2, returns_table(results))
    return joined(parts)


# The marks of the generated parts of the page, and what is between them.
GENERATED = (
    ("<!-- tables of the study -->", "<!-- end of the tables of the study -->", tables),
    ("<!-- tables of the integers -->", "<!-- end of the tables of the integers -->", study_integers.tables),
    ("<!-- tables of the parts -->", "<!-- end of the tables of the parts -->", study_parts.tables),
    ("<!-- tables of the settings -->", "<!-- end of the tables of the settings -->", study_settings.tables),
    ("<!-- tables of the structured -->", "<!-- end of the tables of the structured -->", study_structured.tables),
    ("<!-- tables of the field -->", "<!-- end of the tables of the field -->", study_field.tables),
)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=pathlib.Path, help="folder of the runs' tables")
    parser.add_argument("page", type=pathlib.Path, help="Markdown file with the marks of the tables")
    arguments = parser.parse_args()
    text = arguments.page.read_text()
    for begin, end, generate in GENERATED:
        if begin not in text or end not in text:
            sys.exit(f"study_page: expected {begin} and {end} in {arguments.page}, received none")
        head, tail = text.split(begin)[0], text.split(end)[1]
        text = f"{head}{begin}\n{generate(arguments.results)}\n{end}{tail}"
    arguments.page.write_text(text)


if __name__ == "__main__":
    main()
