"""The tables of the structured tasks: returns, whether attention is needed, and what a decision costs."""

import numpy as np
import seed_statistics
import study_plan
import study_tasks
from run_table import served
from study_tables import ALPHA, count_text, digits_of, energies_in, energy_cells, joined, mean_served, read_runs, row, with_interval

# Comparisons with a model without attention: the best of the task, by its mean over seeds.
BEST = "best"
COMPARED = {"`dense` less the best other": ("dense", BEST), "spiking less the best other": ("spiking", BEST)}
COMPARED |= {"spiking less `dense`": ("spiking", "dense")}


def returns_of(runs, task, arm):
    """Returns the mean returns of the runs of an arm, by seed."""
    return {seed: served(run)["mean_return"] for seed, run in runs.get((task, arm), {}).items()}


def tasks_of(runs):
    return [task for task in study_tasks.STRUCTURED_TASKS if any((task, arm) in runs for arm in study_plan.STRUCTURED_ARMS)]


def returns_table(runs):
    tasks = tasks_of(runs)
    if not tasks:
        return
    yield row(["return", "chance", "expert", *(f"`{arm}`" for arm in study_plan.STRUCTURED_ARMS), "seeds"])
    yield row(["---"] + ["---:"] * (3 + len(study_plan.STRUCTURED_ARMS)))
    for task in tasks:
        plan, digits = study_tasks.STRUCTURED_TASKS[task], digits_of(task)
        found = [returns_of(runs, task, arm) for arm in study_plan.STRUCTURED_ARMS]
        texts = [with_interval(list(returns.values()), digits) if returns else "" for returns in found]
        references = [f"{value:.{digits}f}" for value in (plan.chance, plan.expert_return)]
        yield row([task, *references, *texts, count_text(found)])


def best_clone(runs, task):
    """Returns the arm without attention that has the highest mean, or None."""
    found = {arm: returns_of(runs, task, arm) for arm in study_plan.CLONES_OF_STRUCTURED}
    means = {arm: np.mean(list(returns.values())) for arm, returns in found.items() if returns}
    return max(means, key=means.get) if means else None


def differences(runs, task, first, second):
    """Returns the difference of two arms of every seed that both have."""
    first, second = returns_of(runs, task, first), returns_of(runs, task, second)
    return [first[seed] - second[seed] for seed in sorted(first.keys() & second.keys())]


def comparison_table(runs):
    """Differences of returns by seed, bold where they are beyond chance after Holm's correction for all cells."""
    samples = {}
    for task in tasks_of(runs):
        best = best_clone(runs, task)
        for name, arms in COMPARED.items():
            samples[task, name] = differences(runs, task, *(best if arm == BEST else arm for arm in arms))
    tested = [cell for cell, sample in samples.items() if len(sample) > 1]
    if not tested:
        return
    corrected = seed_statistics.holm([seed_statistics.two_sided(samples[cell], 0.0) for cell in tested])
    p_values = dict(zip(tested, corrected, strict=True))
    yield row(["difference of the returns", "best without attention", *COMPARED])
    yield row(["---", "---", *["---:"] * len(COMPARED)])
    for task in tasks_of(runs):
        cells = [difference(samples[task, name], p_values.get((task, name), 1.0), digits_of(task)) for name in COMPARED]
        yield row([task, f"`{best_clone(runs, task)}`", *cells])


def difference(sample, p_value, digits):
    if len(sample) < 2:
        return ""
    text = f"{np.mean(sample):+z.{digits}f} ± {seed_statistics.half_width(sample):.{digits}f}"
    return f"**{text}**" if p_value < ALPHA else text


def costs_table(runs):
    """What a decision costs: of policies in integers, and multiplications of the other models."""
    tasks = tasks_of(runs)
    if not tasks:
        return
    heads = [f"`{arm}`" for arm in study_plan.CLONES_OF_STRUCTURED]
    energies = energies_in([run for seeds in runs.values() for run in seeds.values()])
    names = [f"{name}, {arm}" for arm in ("`dense`", "spiking") for name in energies]
    yield row(["a decision", *names, "spikes", *(f"multiplications of {head}" for head in heads)])
    yield row(["---"] + ["---:"] * (1 + len(names) + len(heads)))
    for task in tasks:
        of_arm = {arm: list(runs.get((task, arm), {}).values()) for arm in ("dense", "spiking")}
        priced = [*energy_cells(of_arm["dense"], energies), *energy_cells(of_arm["spiking"], energies)]
        priced.append(mean_served(of_arm["spiking"], "spikes_per_decision", 0))
        work = [mean_of(runs, task, arm, lambda run: run["multiplications"], 0) for arm in study_plan.CLONES_OF_STRUCTURED]
        yield row([task, *priced, *work])


def mean_of(runs, task, arm, cost, digits):
    values = [cost(run) for run in runs.get((task, arm), {}).values()]
    return f"{np.mean(values):.{digits}f}" if values else ""


def tables(folder):
    """Returns the fourth generated part of the page."""
    runs = read_runs(folder, "structured")
    return joined([returns_table(runs), comparison_table(runs), costs_table(runs)])
