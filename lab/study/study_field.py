"""The tables of the runs on MuJoCo's datasets: normalised scores and energy."""

import numpy as np
import study_plan
import study_tasks
from run_table import served
from study_tables import ENERGIES, count_text, joined, read_runs, row, score, with_interval


def scores_by_seed(runs, task, arm):
    return {seed: score(run) for seed, run in runs.get((task, arm), {}).items()}


def scores_table(runs):
    """Scores by D4RL's references, and the mean of all sets by the seeds that every set has."""
    tasks = [task for task in study_tasks.FIELD_TASKS if any((task, arm) in runs for arm in study_plan.FIELD_ARMS)]
    if not tasks:
        return
    yield row(["score", *(f"`{arm}`" for arm in study_plan.FIELD_ARMS), "seeds"])
    yield row(["---"] + ["---:"] * (len(study_plan.FIELD_ARMS) + 1))
    cells = {(task, arm): scores_by_seed(runs, task, arm) for task in tasks for arm in study_plan.FIELD_ARMS}
    for task in tasks:
        found = [cells[task, arm] for arm in study_plan.FIELD_ARMS]
        texts = [with_interval(list(scores.values()), 1) if scores else "" for scores in found]
        yield row([task, *texts, count_text(found)])
    seeds = sorted(set.intersection(*(set(scores) for scores in cells.values())))
    if seeds:
        means = [[np.mean([cells[task, arm][seed] for task in tasks]) for seed in seeds] for arm in study_plan.FIELD_ARMS]
        yield row([f"mean of {len(tasks)}", *(with_interval(values, 1) for values in means), str(len(seeds))])


# What a decision costs: what a run says of it, and digits. Policies have spikes and energy, models without attention neither.
COSTS = {
    "spikes": (lambda run: served(run)["spikes_per_decision"] if "multiplications" not in run else None, 0),
    **{name: (lambda run, figure=figure: served(run).get(figure), digits) for name, (figure, digits) in ENERGIES.items()},
    "multiplications": (lambda run: run.get("multiplications"), 0),
}


def costs_table(runs):
    """What a decision costs, as means over all sets and seeds."""
    if not runs:
        return
    yield row(["a decision", *(f"`{arm}`" for arm in study_plan.FIELD_ARMS)])
    yield row(["---"] + ["---:"] * len(study_plan.FIELD_ARMS))
    for name, (cost, digits) in COSTS.items():
        cells = [mean_of(runs, arm, cost, digits) for arm in study_plan.FIELD_ARMS]
        if any(cells):
            yield row([name, *cells])


def mean_of(runs, arm, cost, digits):
    """Returns the mean over all runs of an arm that have this cost."""
    costs = [cost(run) for (_, found), seeds in runs.items() if found == arm for run in seeds.values()]
    known = [value for value in costs if value is not None]
    return f"{np.mean(known):.{digits}f}" if known else ""


def tables(folder):
    """Returns the fifth generated part of the page."""
    runs = read_runs(folder, "field")
    return joined([scores_table(runs), costs_table(runs)])
