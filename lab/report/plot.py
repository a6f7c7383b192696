"""Writes the page of a report and draws its figures from the files that `spikereport` writes.

Writes report.md from runs.json and the results of the runs, if there is a runs.json, and one PNG file for each figure of
figures.json, all into the same directory. Needs matplotlib.
"""

import argparse
import json
import math
import pathlib
import sys

import matplotlib
import report_page
from matplotlib.figure import Figure

DATA_FILE = "figures.json"
PANEL_WIDTH, PANEL_HEIGHT = 4.8, 3.2  # inches
DOTS_PER_INCH = 120

# Colours that readers with any colour vision can tell apart (Okabe and Ito). Line styles and markers differ as well.
COLOURS = ["#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9"]
MARKERS = ["o", "s", "^", "D", "v", "P"]
LINE_STYLES = ["-", "--", "-.", ":", (0, (3, 1, 1, 1, 1, 1)), (0, (5, 1))]

STYLE = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": "medium",
    "font.size": 9,
    "grid.color": "#e0e0e0",
    "legend.frameon": False,
}


class ReportError(Exception):
    """The directory does not hold the data of a report. The message is one line."""


def one_panel(width, height):
    """Returns a figure of this size in inches and its axes."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots()


def panels(count, height=PANEL_HEIGHT):
    """Returns a figure and `count` axes, two in a row."""
    columns = min(2, count)
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(PANEL_WIDTH * columns, height * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for unused in axes[count:]:
        unused.remove()
    return figure, axes[:count]


def legend_above(figure, axis):
    """Puts the legend of `axis` above all panels, in one row."""
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))


def seeds_text(count):
    return "seed 1" if count == 1 else f"{count} seeds"


def draw_losses(tasks):
    figure, axes = panels(len(tasks))
    for axis, (task, losses) in zip(axes, tasks.items(), strict=True):
        for i, (mode, seeds) in enumerate(losses["modes"].items()):
            for seed, points in enumerate(seeds):
                label = {} if seed else {"label": mode}  # one line of the legend for all seeds
                axis.plot(*zip(*points, strict=True), color=COLOURS[i], linestyle=LINE_STYLES[i], **label)
        curves = max(len(seeds) for seeds in losses["modes"].values())
        axis.set(title=f"{task}, {seeds_text(curves)}", xlabel="training iteration", ylabel=f"held-out loss\n({losses['unit']})")
    legend_above(figure, axes[0])
    return figure


def draw_spikes_by_stage(tasks):
    figure, axes = panels(len(tasks))
    for axis, (task, modes) in zip(axes, tasks.items(), strict=True):
        width = 0.8 / len(modes)
        for i, (mode, stages) in enumerate(modes.items()):
            places = [stage + (i - (len(modes) - 1) / 2) * width for stage in range(len(stages))]
            axis.bar(places, stages.values(), width, label=mode, color=COLOURS[i])
        axis.set_xticks(range(len(stages)), stages, rotation=30, ha="right", rotation_mode="anchor")
        axis.grid(visible=False, axis="x")
        axis.set(title=f"{task}, seed 1", xlabel="stage of the model", ylabel="mean spikes per decision")
    legend_above(figure, axes[0])
    return figure


def draw_spikes_per_decision(tasks):
    figure, axes = panels(len(tasks))
    for axis, (task, modes) in zip(axes, tasks.items(), strict=True):
        for i, (mode, histogram) in enumerate(modes.items()):
            axis.stairs(histogram["decisions"], histogram["edges"], fill=True, label=mode, color=COLOURS[i], alpha=0.6)
        axis.grid(visible=False, axis="x")
        axis.yaxis.get_major_locator().set_params(integer=True)
        axis.set(title=f"{task}, seed 1, one episode", xlabel="spikes per decision", ylabel="number of decisions")
    legend_above(figure, axes[0])
    return figure


def draw_phases(tasks):
    figure, axis = one_panel(1.5 * PANEL_WIDTH, 1.2 * PANEL_HEIGHT)
    for i, (task, generators) in enumerate(tasks.items()):
        omega, phi = zip(*generators, strict=True)
        # Outlines of different sizes stay visible where the generators of several tasks coincide.
        size = 20 * (len(tasks) - i)
        axis.scatter(omega, phi, size, label=task, facecolor="none", edgecolor=COLOURS[i], marker=MARKERS[i])
    axis.set(
        title="Phase generators after training, full, all seeds",
        xlabel="frequency ω (rad per timestep)",
        ylabel="phase φ (rad)",
    )
    legend_above(figure, axis)
    return figure


def draw_phase_spikes(data):
    heads = data["heads"]
    figure, axis = one_panel(2 * PANEL_WIDTH, 0.9 + 0.4 * len(heads))
    axis.eventplot(heads, colors=COLOURS[0], linelengths=0.7, linewidths=1.2)
    axis.set_yticks(range(len(heads)))
    axis.xaxis.get_major_locator().set_params(integer=True)
    axis.grid(visible=False, axis="y")
    axis.set(
        title=f"{data['task']}, full, seed 1: phase spikes",
        xlabel="time in the window (timesteps)",
        ylabel="head",
        xlim=(0, data["timesteps"]),
        ylim=(-0.6, len(heads) - 0.4),
    )
    return figure


def draw_gates(tasks):
    maps = [(task, mode, gates) for task, modes in tasks.items() for mode, gates in modes.items()]
    figure, axes = panels(len(maps), height=2.2)
    for axis, (task, mode, gates) in zip(axes, maps, strict=True):
        image = axis.imshow(gates, aspect="auto", origin="lower", cmap="cividis", interpolation="nearest")
        figure.colorbar(image, ax=axis, label="mean gate (no unit)")
        axis.set_yticks(range(len(gates)))
        axis.grid(visible=False)
        axis.set(title=f"{task}, {mode}, seed 1", xlabel="token of the window, oldest first", ylabel="head")
    return figure


def draw_membrane(data):
    figure, axis = one_panel(1.5 * PANEL_WIDTH, PANEL_HEIGHT)
    for i, (current, potentials) in enumerate(data["potentials"]):
        axis.plot(potentials, label=f"I = {current:g}", color=COLOURS[i], linestyle=LINE_STYLES[i])
    axis.axhline(data["threshold"], label="threshold", color="#666666", linewidth=0.8)
    axis.set(
        title="One neuron under constant input currents I (no unit)",
        xlabel="time (ticks)",
        ylabel="membrane potential V\nafter the tick (no unit)",
    )
    legend_above(figure, axis)
    return figure


def draw_surrogates(data):
    figure, axis = one_panel(1.5 * PANEL_WIDTH, PANEL_HEIGHT)
    for i, (kind, points) in enumerate(data["curves"].items()):
        axis.plot(*zip(*points, strict=True), label=kind.replace("_", " "), color=COLOURS[i], linestyle=LINE_STYLES[i])
    axis.set(
        title=f"Surrogate gradients, slope {data['slope']:g}",
        xlabel="distance to the threshold V - V_th (no unit)",
        ylabel="ds/du (no unit)",
    )
    legend_above(figure, axis)
    return figure


# The members of figures.json; each becomes the PNG file of that name.
FIGURES = {
    "losses": draw_losses,
    "spikes_by_stage": draw_spikes_by_stage,
    "spikes_per_decision": draw_spikes_per_decision,
    "phases": draw_phases,
    "phase_spikes": draw_phase_spikes,
    "gates": draw_gates,
    "membrane": draw_membrane,
    "surrogates": draw_surrogates,
}


def read_figures(report):
    """Returns the data of the figures by name. Raises ReportError."""
    path = report / DATA_FILE
    if not path.is_file():
        raise ReportError(f"report: expected a directory with {DATA_FILE}, received {report}")
    try:
        figures = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ReportError(f"report: expected JSON in {path}, received invalid text ({error})") from error
    if not isinstance(figures, dict) or not figures:
        raise ReportError(f"report: expected an object of figures in {path}, received {json.dumps(figures)[:60]}")
    if unknown := sorted(figures.keys() - FIGURES.keys()):
        raise ReportError(f"report: expected the figures {', '.join(FIGURES)} in {path}, received {unknown[0]!r}")
    return figures


def draw(name, data):
    """Returns the figure. Raises ReportError if `data` has another shape than `spikereport` writes."""
    try:
        return FIGURES[name](data)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise ReportError(
            f"report: expected the data of {name} in {DATA_FILE}, received other data"
            f" ({type(error).__name__}: {error})".replace("\n", " ")
        ) from error


def write_page(report, figures):
    """Writes report.md and returns its path. Raises ReportError if the report's files hold other data."""
    try:
        return report_page.write(report, figures)
    except (AttributeError, LookupError, OSError, TypeError, ValueError) as error:
        raise ReportError(
            f"report: expected the runs of {report_page.RUNS_FILE} in {report}, received other data"
            f" ({type(error).__name__}: {error})".replace("\n", " ")
        ) from error


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", type=pathlib.Path, help=f"directory with {DATA_FILE}, written by spikereport")
    report = parser.parse_args().report
    try:
        with matplotlib.rc_context(STYLE):
            figures = {name: draw(name, data) for name, data in read_figures(report).items()}
            for name, figure in figures.items():
                path = report / f"{name}.png"
                figure.savefig(path, dpi=DOTS_PER_INCH)
                print(path)
        if (report / report_page.RUNS_FILE).is_file():
            print(write_page(report, figures))
    except ReportError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
