"""The page of a report: the paper's tables from the finished runs of `spikereport`, beside the paper's own numbers.

Reads runs.json and the result.json of every run in the report's directory.
"""

import json
import math
import pathlib
import statistics
import sys

sys.path.append(str(pathlib.Path(__file__).parents[1] / "study"))
import seed_statistics

RUNS_FILE = "runs.json"
MODES = ("baseline", "pos", "route", "full", "dense")
COMPARED = (("pos", "baseline"), ("route", "baseline"), ("full", "baseline"), ("full", "dense"))

# The paper's results for its four spiking modes, in the order of MODES.
PAPERS_RETURNS = {  # its Table 4, means over 50 episodes
    "CartPole-v1": (452.3, 474.1, 479.2, 492.3),
    "MountainCar-v0": (-120.2, -111.5, -109.8, -102.4),
    "Acrobot-v1": (-87.1, -72.0, -68.3, -59.7),
    "Pendulum-v1": (-155.3, -140.0, -135.4, -130.5),
}
PAPERS_LOSSES = (0.68, 0.63, 0.61, 0.55)  # its Table 2, epoch 100
PAPERS_SPIKES = (12000, 11000, 9000, 8000)  # its Table 3, per inference
PAPERS_MILLISECONDS = (15.2, 14.8, 13.5, 12.1)  # its Table 3
# Returns by dynamic programming and search, means over Gymnasium's seeds 0 to 999.
OPTIMA = {"CartPole-v1": 500.0, "MountainCar-v0": -97.56, "Acrobot-v1": -58.68, "Pendulum-v1": -135.30}


def interval(values):
    """Returns the mean, and half the width of its 95 % confidence interval, which is infinite for a single value."""
    mean = statistics.fmean(values)
    if len(values) < 2:
        return mean, math.inf
    return mean, seed_statistics.half_width(values)


def with_interval(values, digits):
    mean, half_width = interval(values)
    return f"{mean:.{digits}f} " + ("(one seed)" if math.isinf(half_width) else f"± {half_width:.{digits}f}")


def returns_of(runs):
    return [run["evaluation"]["mean_return"] for run in runs]


def spikes_of(runs, unit="decision"):
    return [run["evaluation"][f"spikes_per_{unit}"] for run in runs]


def milliseconds_of(runs):
    return f"{1e3 * statistics.fmean(run['seconds_per_decision'] for run in runs):.3f}"


def table(header, rows):
    return "\n".join(f"| {' | '.join(row)} |" for row in (header, ["---"] * len(header), *rows))


def code(lines):
    return "\n".join(["```", *lines, "```"])


def introduction(settings):
    return (
        "Every mode on every task from {seeds} seed(s). The data of a seed are {steps} steps: {expert:g} % from the expert, "
        "{disturbed:g} % from the expert disturbed by bursts of random actions, and the rest from random actions. Training takes "
        "{iterations} iterations of {batch} clips; d = {hidden_size}, T = {ticks}, N = {context}. Returns are means over "
        "{episodes} starts a seed that training never saw, from environment seed 2000000 on. ± is half the width of a 95 % "
        "confidence interval by Student's t over seeds; a difference that is larger than it is called significant."
    ).format(
        expert=100 * settings["expert_fraction"], disturbed=100 * settings["disturbed_fraction"], **settings
    )


def comparison(ours, mode, other):
    """Returns how much more `mode` returns than `other`, paired by seed, and whether that is significant."""
    pairs = zip(returns_of(ours[mode]), returns_of(ours[other]), strict=True)
    mean, half_width = interval([a - b for a, b in pairs])
    # A difference of one seed has an infinite interval, which reads "inf" as in C.
    significant = "significant" if abs(mean) > half_width else "not significant"
    sign = "less" if mean < 0 else "more"
    return f"{mode} returns {abs(mean):.1f} ± {half_width:.1f} {sign} than {other} ({significant})"


def papers(values, mode, digits):
    """Returns the paper's value of a mode, which has none of `dense` and of other tasks."""
    return f"{values[MODES.index(mode)]:.{digits}f}" if values and mode != "dense" else ""


def returns_section(groups):
    rows = []
    for task, modes in groups.items():
        optimum = f"{OPTIMA[task]:.1f}" if task in OPTIMA else ""
        for mode, runs in modes.items():
            papers_return = papers(PAPERS_RETURNS.get(task), mode, 1)
            rows.append([task, mode, with_interval(returns_of(runs), 1), papers_return, optimum])
    yield table(["task", "mode", "return", "the paper's", "optimum"], rows)
    for task, modes in groups.items():
        yield f"{task}, paired by seed and data: {'; '.join(comparison(modes, *pair) for pair in COMPARED)}."


def losses_table(groups):
    rows = []
    for task, modes in groups.items():
        for mode, runs in modes.items():
            if runs[0]["losses"]:
                losses = with_interval([run["losses"][-1][1] for run in runs], 4)
                rows.append([task, mode, losses, papers(PAPERS_LOSSES, mode, 2)])
    return table(["task", "mode", "loss at the end", "the paper's, one figure for all tasks"], rows)


def spikes_table(groups):
    rows = []
    for task, modes in groups.items():
        for mode, runs in modes.items():
            if mode != "dense":
                spikes = [with_interval(spikes_of(runs, unit), 1) for unit in ("decision", "window")]
                counted, taken = papers(PAPERS_SPIKES, mode, 0), papers(PAPERS_MILLISECONDS, mode, 1)
                rows.append([task, mode, *spikes, counted, milliseconds_of(runs), taken])
    papers_spikes = "the paper's spikes per inference"
    return table(["task", "mode", "spikes per decision", "spikes per window", papers_spikes, "milliseconds", "the paper's"], rows)


def sweeps_table(groups, sweeps):
    """Returns a row for each T and N. The shape of all other runs comes first."""
    task, shapes = sweeps[0]["task"], {}
    for run in groups[task]["full"] + sweeps:
        shapes.setdefault((run["ticks"], run["context"]), []).append(run)
    rows = [
        [task, *map(str, shape), with_interval(returns_of(runs), 1), with_interval(spikes_of(runs), 1), milliseconds_of(runs)]
        for shape, runs in shapes.items()
    ]
    return table(["task", "T", "N", "return", "spikes per decision", "milliseconds"], rows)


def gates_table(groups):
    rows = []
    for task, modes in groups.items():
        for mode in ("route", "full"):
            if gates := modes[mode][0]["gates"]:
                extremes = min(map(min, gates)), max(map(max, gates)), max(max(head) - min(head) for head in gates)
                rows.append([task, mode, *(f"{value:.3f}" for value in extremes)])
    return table(["task", "mode", "least gate", "largest gate", "most that one head's gate varies"], rows)


def sections(data, figures):
    """Yields the parts of the page. `figures` names the figures that have data."""

    def figure(name, text):
        if name in figures:
            yield f"![{text}]({name}.png)"

    groups = {}  # {task: {mode: runs by seed}}
    for run in data["modes"]:
        groups.setdefault(run["task"], {}).setdefault(run["mode"], []).append(run)
    yield "# The paper's experiments, measured"
    yield introduction(data["settings"])
    yield "These commands make the report; the second one draws the figures from figures.json:"
    yield code(data["commands"])
    yield "## Returns by mode and task (the paper's Table 4)"
    yield from returns_section(groups)
    yield "## Loss on held-out episodes (the paper's Table 2)"
    yield from figure("losses", "Loss on held-out episodes over the iterations of training, by mode, every seed")
    yield losses_table(groups)
    yield "## Spikes and latency by mode (the paper's Table 3)"
    yield (
        "The paper counts the spikes of one inference, which computes a full window; a decision here computes only its three new "
        "tokens. Milliseconds are the time of one decision of the streaming engine and one step of the environment, on the machine "
        "that made this report; the paper's are the time of a forward and a backward pass on another machine."
    )
    yield from figure("spikes_by_stage", "Mean spikes per decision in each stage of the model, by mode, seed 1")
    yield from figure(
        "spikes_per_decision", "Histograms of the spikes of the decisions of one episode, baseline and full, seed 1"
    )
    yield spikes_table(groups)
    if data["sweeps"]:
        yield "## Sweeps of ticks and context (the paper's appendix)"
        yield sweeps_table(groups, data["sweeps"])
    yield "## Phase generators"
    yield (
        "The frequency and phase of every generator after training, in full mode, and the spikes of the first task's generators "
        "over one window, seed 1."
    )
    yield from figure("phases", "Frequency and phase of every phase generator after training, by task")
    yield from figure("phase_spikes", "Spikes of every head's phase generator over one window")
    yield "## Routing gates"
    yield (
        "The gates of the first layer as means over ticks, over the window of the last decision of an episode, seed 1 (the paper's "
        "heatmaps). Uniform gates equal 1/H."
    )
    yield from figure("gates", "Mean gate of every head for every token of the window, by task and mode")
    yield gates_table(groups)
    yield "## The neuron"
    yield (
        "The membrane potential of one neuron under three constant input currents. The neuron has no trained parameters."
    )
    yield from figure("membrane", "Membrane potential after each tick under three constant input currents")
    yield (
        "The surrogate gradients that replace the derivative of its spike in training, with the slope of these runs."
    )
    yield from figure("surrogates", "Derivative of each surrogate over the distance to the threshold")
    yield "## The command of every run"
    by_task_and_mode = sorted(data["modes"], key=lambda run: (run["task"], MODES.index(run["mode"])))
    yield code(run["command"] for run in by_task_and_mode + data["sweeps"])


def write(report, figures):
    """Writes report.md into the directory of the report. Raises OSError, ValueError or LookupError for other files."""
    data = json.loads((report / RUNS_FILE).read_text(encoding="utf-8"))
    for part in ("modes", "sweeps"):
        data[part] = [
            {**run, **json.loads((report / run["run"] / "result.json").read_text(encoding="utf-8"))} for run in data[part]
        ]
    page = report / "report.md"
    page.write_text("".join(f"{section}\n\n" for section in sections(data, figures)), encoding="utf-8")
    return page
