"""What the tables of the study have in common."""

import numpy as np
import seed_statistics
import study_tasks
from run_table import read_results, served

ALPHA = 0.05


# The former ten seeds, whose policies were not played in integers. While this table is there, it is the one that is ranked.
FORMER = "float32"


def ranked_group(folder):
    """Returns the group whose runs of the study are ranked: the former one as a whole, or the present one as a whole."""
    return FORMER if read_results(folder, FORMER) else "study"


def read_runs(folder, group="study"):
    """Returns all results of a group by task and arm, and each of these by seed."""
    runs = {}
    for result in read_results(folder, group):
        runs.setdefault((result["task"], result["arm"]), {})[result["seed"]] = result
    return runs


def row(cells):
    return f"| {' | '.join(cells)} |"


def joined(tables):
    """Returns the text of tables, each of which is a sequence of lines; those without a line are left out."""
    texts = ("\n".join(table) for table in tables)
    return "\n\n".join(text for text in texts if text)


def points(task, value):
    """Returns the score of a return: 0 for random actions, 100 for the expert."""
    plan = study_tasks.ALL_TASKS[task]
    return 100 * (value - plan.chance) / (plan.expert_return - plan.chance)


def score(result):
    return points(result["task"], served(result)["mean_return"])


# The energies of a table, with memory first, and their digits.
ENERGIES = {"nJ with memory": ("int_sram_nanojoules_per_decision", 0), "nJ without": ("int_nanojoules_per_decision", 1)}


def energies_in(runs):
    """Returns the energies that a table of these runs has: none if no run is priced."""
    return ENERGIES if any("int_nanojoules_per_decision" in served(run) for run in runs) else {}


def energy_cells(runs, energies):
    """Returns the mean energies of runs as they are served; empty cells where a run has none."""
    return [mean_served(runs, *figure) for figure in energies.values()]


def mean_served(runs, figure, digits):
    values = [served(run).get(figure) for run in runs]
    return f"{np.mean(values):.{digits}f}" if values and None not in values else ""


def digits_of(task):
    """Returns the digits of a task's returns after the point."""
    return 1 if abs(study_tasks.ALL_TASKS[task].expert_return) > 10 else 3


def with_interval(values, digits):
    """Returns a mean over seeds with Student's interval."""
    half = f" ± {seed_statistics.half_width(values):.{digits}f}" if len(values) > 1 else ""
    return f"{np.mean(values):.{digits}f}{half}"


def count_text(groups):
    """Returns the number of values in each group, or the smallest and the largest number."""
    counts = [len(group) for group in groups]
    return " to ".join(str(count) for count in sorted({min(counts), max(counts)}))
