"""Prints in per cent how much better the modes of a report are than `baseline` (the paper's eq. 8), as Markdown.

Reads report.md and figures.json in the directory that `spikereport` wrote. Returns are the differences by seed
that report.md has, divided by the size of the mean of `baseline`. Losses are means over the seeds in figures.json after
a fifth, half and all of the training, which are epochs 20, 50 and 100 of the 100 in the paper's table 2.
"""

import argparse
import json
import pathlib
import re
import statistics
import sys

MODES = ("pos", "route", "full")
SHARES = (0.2, 0.5, 1.0)  # of the training
# Table 2 of the paper.
PAPERS_LOSSES = {
    "baseline": (0.80, 0.72, 0.68),
    "pos": (0.76, 0.68, 0.63),
    "route": (0.74, 0.66, 0.61),
    "full": (0.70, 0.60, 0.55),
}

# Task, mode, our mean, the paper's mean.
RETURN = re.compile(r"^\| (\S+) \| (\w+) \| (\S+) (?:± \S+|\(one seed\)) \| (\S+) \| \S+ \|$", re.MULTILINE)
PARAGRAPH = re.compile(r"^(\S+), paired by seed and data: (.*)$", re.MULTILINE)
DIFFERENCE = re.compile(r"(\w+) returns (\S+) ± (\S+) (more|less) than baseline")


def gain(value, baseline):
    """Returns by how many per cent of the size of `baseline` a value lies above it."""
    return 100 * (value - baseline) / abs(baseline)


def row(cells):
    return f"| {' | '.join(cells)} |"


def returns_table(markdown):
    """Returns the lines of the table of returns."""
    ours, papers = {}, {}
    for task, mode, mean, paper in RETURN.findall(markdown):
        ours[task, mode], papers[task, mode] = float(mean), float(paper)
    tasks = list(dict.fromkeys(task for task, _ in ours))
    here = {}
    for task, sentences in PARAGRAPH.findall(markdown):
        if task not in tasks:
            continue  # the paper does not play it
        scale = 100 / abs(ours[task, "baseline"])
        for mode, size, interval, sign in DIFFERENCE.findall(sentences):
            difference = float(size) if sign == "more" else -float(size)
            here[task, mode] = f"{scale * difference:z.1f} ± {scale * float(interval):.1f}"
    yield row(["return, per cent above `baseline`", *tasks])
    yield row(["---"] + ["---:"] * len(tasks))
    for mode in MODES:
        printed = [f"{gain(papers[task, mode], papers[task, 'baseline']):.1f}" for task in tasks]
        yield row([f"`{mode}`, the paper", *printed])
        yield row([f"`{mode}`, here", *(here[task, mode] for task in tasks)])


def mean_curve(seeds):
    """Returns the mean loss of the seeds by iteration, which is the same in all."""
    return {points[0][0]: statistics.fmean(loss for _, loss in points) for points in zip(*seeds, strict=True)}


def losses_table(losses):
    """Returns the lines of the table of losses. `losses` is the member of figures.json."""
    yield row(["loss, per cent below `baseline`", "the paper", *losses])
    yield row(["---"] + ["---:"] * (1 + len(losses)))
    for mode in MODES:
        pairs = zip(PAPERS_LOSSES[mode], PAPERS_LOSSES["baseline"], strict=True)
        cells = [", ".join(f"{-gain(*pair):z.1f}" for pair in pairs)]
        for task in losses.values():
            ours, baseline = mean_curve(task["modes"][mode]), mean_curve(task["modes"]["baseline"])
            nearest = [min(ours, key=lambda iteration: abs(iteration - share * max(ours))) for share in SHARES]
            cells.append(", ".join(f"{-gain(ours[iteration], baseline[iteration]):z.1f}" for iteration in nearest))
        yield row([f"`{mode}`", *cells])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", type=pathlib.Path, help="directory that spikereport wrote")
    report = parser.parse_args().report
    for name in ("report.md", "figures.json"):
        if not (report / name).is_file():
            sys.exit(f"report: expected a directory with {name}, received {report}")
    print("\n".join(returns_table((report / "report.md").read_text())), end="\n\n")
    print("\n".join(losses_table(json.loads((report / "figures.json").read_text())["losses"])))


if __name__ == "__main__":
    main()
