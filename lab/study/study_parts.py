"""The tables of the parts: `full` with one thing changed, longer contexts, and shorter trainings."""

import numpy as np
import seed_statistics
import study_plan
import study_tasks
from study_tables import ALPHA, energies_in, energy_cells, joined, mean_served, ranked_group, read_runs, row, score

FIGURES = (("mean_return", 1), ("spikes_per_decision", 0))


def paired(runs, task, arm, measure):
    """Returns the values of a measure of `arm` and of `full`, of every seed that both have."""
    first, second = runs.get((task, arm), {}), runs.get((task, "full"), {})
    seeds = sorted(first.keys() & second.keys())
    return np.array([measure(first[seed]) for seed in seeds]), np.array([measure(second[seed]) for seed in seeds])


def changes_table(runs):
    """How much better the score is than that of `full`, with 95 % intervals; those beyond chance are bold."""
    arms = [arm for arm in study_plan.PARTS if not arm.endswith(tuple(study_plan.SHARES))]
    cells = {(arm, task): paired(runs, task, arm, score) for arm in arms for task in study_plan.PART_TASKS}
    samples = {cell: first - second for cell, (first, second) in cells.items() if len(first)}
    tested = {cell: sample for cell, sample in samples.items() if len(sample) > 1}
    corrected = seed_statistics.holm([seed_statistics.two_sided(sample, 0.0) for sample in tested.values()])
    p_values = dict(zip(tested, corrected, strict=True))
    if not samples:
        return
    yield row(["`full`, but", *study_plan.PART_TASKS, "spikes, times"])
    yield row(["---"] + ["---:"] * (1 + len(study_plan.PART_TASKS)))
    for arm in arms:
        if not any((arm, task) in samples for task in study_plan.PART_TASKS):
            continue
        yield row(
            [
                f"`{arm}`",
                *(difference(samples.get((arm, task)), p_values.get((arm, task), 1.0)) for task in study_plan.PART_TASKS),
                ratio(runs, arm, "spikes_per_decision"),
            ]
        )


def ratio(runs, arm, figure):
    """Returns the mean ratio of a figure to that of `full`, over the tasks whose results have it."""
    pairs = [paired(runs, task, arm, lambda run: run.get(figure, np.nan)) for task in study_plan.PART_TASKS]
    ratios = np.concatenate([first / second for first, second in pairs])
    ratios = ratios[~np.isnan(ratios)]
    return f"{np.mean(ratios):.2f}" if len(ratios) else ""


def difference(sample, p_value):
    if sample is None:
        return ""
    if len(sample) < 2:
        return f"{sample[0]:+z.1f} (one seed)"
    half = seed_statistics.half_width(sample)
    text = f"{np.mean(sample):+z.1f} ± {half:.1f}"
    return f"**{text}** ({len(sample)})" if p_value < ALPHA else f"{text} ({len(sample)})"


def longer_tables(runs):
    """The returns of policies in a context that is longer than that of their training."""
    for name, task in study_tasks.TASKS.items():
        played = {arm: [run for run in runs.get((name, arm), {}).values() if "longer" in run] for arm in study_plan.MODES}
        if not task.longer or not any(played.values()):
            continue
        trained = next(flag.removeprefix("--context=") for flag in task.flags if flag.startswith("--context="))
        lines = [
            row([f"{name}, trained with N = {trained}", *(f"N = {context}" for context in (trained, *task.longer)), "seeds"])
        ]
        lines.append(row(["---"] + ["---:"] * (2 + len(task.longer))))
        for arm, seeds in ((arm, seeds) for arm, seeds in played.items() if seeds):
            means = [np.mean([run["mean_return"] for run in seeds])]
            means += [np.mean([run["longer"][str(context)] for run in seeds]) for context in task.longer]
            lines.append(row([f"`{arm}`", *(f"{mean:.1f}" for mean in means), str(len(seeds))]))
        yield lines


def shares_table(runs):
    """Return and loss after trainings of several lengths; the whole one is that of the study."""
    arms = {(mode, share): f"{mode}-{share}" for share in study_plan.SHARES for mode in study_plan.MODES_OF_SHARES}
    arms |= {(mode, "whole"): mode for mode in study_plan.MODES_OF_SHARES}
    shares = [*study_plan.SHARES, "whole"]
    if not any((task, arms[mode, "quarter"]) in runs for task in study_plan.PART_TASKS for mode in study_plan.MODES_OF_SHARES):
        return
    yield row(["return, validation loss", *(f"{share} of the iterations" for share in shares), "seeds"])
    yield row(["---"] + ["---:"] * (1 + len(shares)))
    for task in study_plan.PART_TASKS:
        for mode in study_plan.MODES_OF_SHARES:
            found = [runs.get((task, arms[mode, share]), {}) for share in shares]
            seeds = set.intersection(*(set(seeds) for seeds in found))
            if not seeds:
                continue
            cells = []
            for runs_of_share in found:
                chosen = [runs_of_share[seed] for seed in seeds]
                mean = np.mean([run["mean_return"] for run in chosen])
                loss = np.mean([run["validation_loss"] for run in chosen])
                cells.append(f"{mean:.4g}, {loss:.3f}")
            yield row([f"{task}, `{mode}`", *cells, str(len(seeds))])


def tick_table(runs):
    """The ticks of `full` against one."""
    arms = [(task, arm) for task in study_plan.PART_TASKS for arm in ("full", "long", "tick-1") if (task, arm) in runs]
    if not any(arm == "tick-1" for _, arm in arms):
        return
    energies = energies_in([run for cell in arms for run in runs[cell].values()])
    yield row(["task", "", "seeds", "return", "spikes", *energies])
    yield row(["---", "---", *["---:"] * (3 + len(energies))])
    for task, arm in arms:
        seeds = runs[task, arm].values()
        yield row(
            [
                *(task, f"`{arm}`", str(len(seeds))),
                *(mean_served(seeds, figure, digits) for figure, digits in FIGURES),
                *energy_cells(seeds, energies),
            ]
        )


def tables(folder):
    """Returns the second generated part of the page."""
    runs = read_runs(folder, ranked_group(folder))
    return joined([changes_table(runs), *longer_tables(runs), shares_table(runs), tick_table(runs)])
