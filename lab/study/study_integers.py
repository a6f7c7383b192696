"""The tables of what the policies of the study lose in integers, and of the rounding that the gate refuses."""

import numpy as np
import study_plan
import study_tasks
from run_table import read_results
from study_tables import digits_of, joined, points, row


def served_runs(folder):
    """Returns the runs that have integers, by task and mode."""
    runs = {}
    for result in [*read_results(folder, "study"), *read_results(folder, "paper")]:
        if "integer" in result and result["arm"] in study_plan.MODES:
            runs.setdefault((result["task"], result["arm"]), []).append(result)
    return runs


def lost(run, part="integer"):
    """Returns the points of the score that integers lose."""
    return points(run["task"], run["mean_return"]) - points(run["task"], run[part]["mean_return"])


def loss_table(runs):
    """A row for each task and mode. What is refused is trained through the rounding."""
    yield row(["task", "mode", "seeds", "float32", "integers", "lost, median", "worst", "refused", "trained through", "nJ with memory"])
    yield row(["---", "---", *["---:"] * 8])
    for task in [*study_tasks.TASKS, *study_tasks.TASKS_OF_THE_PAPER]:
        for mode in study_plan.MODES:
            group = runs.get((task, mode), [])
            if not group:
                continue
            losses, digits = [lost(run) for run in group], digits_of(task)
            refused = [run for run in group if "rounded" in run or run["integer"]["refused"]]
            through = ", ".join(f"{lost(run, 'rounded'):z.1f} to {lost(run):z.1f}" for run in group if "rounded" in run)
            figures = [[run["mean_return"] for run in group], [run["integer"]["mean_return"] for run in group]]
            yield row(
                [
                    *(task, f"`{mode}`", str(len(group))),
                    *(f"{np.mean(values):.{digits}f}" for values in figures),
                    *(f"{np.median(losses):z.1f}", f"{max(losses):z.1f}", str(len(refused)), through),
                    f"{np.mean([run['integer']['int_sram_nanojoules_per_decision'] for run in group]):.0f}",
                ]
            )


def summary(runs):
    """One line: what the runs lose, and what the gate refuses."""
    every = [run for group in runs.values() for run in group]
    if not every:
        return
    first = [run.get("rounded", run["integer"]) for run in every]
    kept = [lost(run) for run in every if not run["integer"]["refused"]]
    through = [run for run in every if "rounded" in run]
    refused = [run for run in every if run["integer"]["refused"]]
    worst = f", at most {max(kept):z.1f} in a file that is served" if kept else ""
    yield (
        f"{len(every)} runs lose {np.median([lost(run) for run in every]):z.1f} points of 100 in the median{worst}. The gate refused "
        f"{sum(rounded['refused'] for rounded in first)} roundings; {len(through)} were trained through it, after which it refuses "
        f"{sum(run['integer']['refused'] for run in through)}. Refused and served by no server: {len(refused)}."
    )


def tables(folder):
    """Returns the generated part of the page."""
    runs = served_runs(folder)
    return joined([summary(runs), loss_table(runs)])
