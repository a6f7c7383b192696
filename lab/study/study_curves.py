"""Draws the validation losses of the runs with the paper's own settings, by epoch (the paper's figures 11, 14 and 18).

    python lab/study/study_curves.py lab/study/runs lab/evidence/settings.png

Needs matplotlib.
"""

import argparse
import pathlib
import sys

import matplotlib
import study_plan
import study_tasks
from study_settings import losses_of
from study_tables import read_runs

sys.path.append(str(pathlib.Path(__file__).parents[1] / "report"))
from plot import COLOURS, DOTS_PER_INCH, LINE_STYLES, STYLE, panels  # noqa: E402


def draw(runs):
    """Returns a figure with a panel for each task and setting that has runs."""
    drawn = [task for task in study_tasks.TASKS_OF_SETTINGS if any((task, mode) in runs for mode in study_plan.MODES)]
    figure, axes = panels(len(drawn))
    for axis, task in zip(axes, drawn, strict=True):
        axis.set_title(task)
        axis.set_xlabel("epoch")
        axis.set_ylabel("validation loss")
        for mode, colour, style in zip(study_plan.MODES, COLOURS, LINE_STYLES, strict=False):
            for run in runs.get((task, mode), {}).values():
                losses = losses_of(run)
                axis.plot(list(losses), list(losses.values()), color=colour, linestyle=style, label=mode)
        axis.legend()
    return figure


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=pathlib.Path, help="folder of the runs' tables")
    parser.add_argument("figure", type=pathlib.Path, help="PNG file")
    arguments = parser.parse_args()
    with matplotlib.rc_context(STYLE):
        draw(read_runs(arguments.results, "settings")).savefig(arguments.figure, dpi=DOTS_PER_INCH)


if __name__ == "__main__":
    main()
