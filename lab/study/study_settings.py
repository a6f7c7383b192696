"""The table of the runs with the paper's own settings: losses by epoch, and what its text says of them."""

import study_plan
import study_tasks
from study_tables import joined, read_runs, row

EPOCHS = (20, 50, 100, 200)  # of the paper's table 2, and of its figure 18


def first_epoch_below(losses, bound):
    """Returns the first epoch whose loss is at most `bound`, or None."""
    return next((epoch for epoch, loss in losses.items() if loss <= bound), None)


def losses_of(run):
    """Returns the validation losses of a run by epoch."""
    return {int(epoch): loss for epoch, loss in run["losses"].items()}


def speed(losses, baseline):
    """How many times faster than `baseline` a run reached the lowest loss of `baseline`."""
    lowest = min(baseline.values())
    epoch = first_epoch_below(losses, lowest)
    return f"{first_epoch_below(baseline, lowest) / epoch:.2f}" if epoch else "never"


def settings_table(runs, task):
    arms = {mode: runs[task, mode] for mode in study_plan.MODES if (task, mode) in runs}
    if not arms:
        return
    epochs = [epoch for epoch in EPOCHS if epoch <= study_tasks.TASKS_OF_SETTINGS[task].settings.epochs]
    yield row([task, *(f"epoch {epoch}" for epoch in epochs), "lowest, of `baseline`'s", "speed", "return", "spikes"])
    yield row(["---"] + ["---:"] * (len(epochs) + 4))
    for mode, seeds in arms.items():
        run = seeds[1]
        losses = losses_of(run)
        compared = ["", ""]
        if "baseline" in arms and mode != "baseline":
            baseline = losses_of(arms["baseline"][1])
            compared = [f"{min(losses.values()) / min(baseline.values()):.2f}", speed(losses, baseline)]
        figures = [f"{run['mean_return']:.1f}", f"{run['spikes_per_decision']:.0f}"]
        yield row([f"`{mode}`", *(f"{losses[epoch]:.3f}" for epoch in epochs), *compared, *figures])


def tables(folder):
    """Returns the third generated part of the page."""
    runs = read_runs(folder, "settings")
    return joined([settings_table(runs, task) for task in study_tasks.TASKS_OF_SETTINGS])
