"""Measures the table of lab/evidence/imitators.md: one `imitate` after the other, with environment and expert only.

    python lab/recipes/imitation_table.py --out=FOLDER [--modes=dense,baseline] [--rows=Spring,Vehicle]
    python lab/recipes/imitation_table.py --out=FOLDER --print

The first form trains. It needs what docs/guides/imitation.md installs, and PYTHONPATH as lab/evidence/imitators.md sets it.
The same command continues after an interruption, and leaves out what is finished. The second form prints
the runs that are finished, in Markdown.
"""

import argparse
import json
import os
import pathlib
import re
import shlex
import subprocess
import sys
import time

import numpy as np

# Environments and their experts.
ROWS = {
    "hidden_state:Spring-v0": "hidden_state:hold",
    "hidden_state:Vehicle-v0": "hidden_state:brake",
    "hidden_state:Thermostat-v0": "hidden_state:heat",
    "hidden_state:Reacher2D-v0": "hidden_state:reach",
    "hidden_state:AnglePendulum-v0": "hidden_state:swing_up",
    "MountainCarContinuous-v0": "experts:rock",
    "LunarLander-v3": "gymnasium.envs.box2d.lunar_lander:heuristic",
    "InvertedDoublePendulum-v5": "experts:balance_double_pendulum",
}
MODES = {"dense": "dense", "baseline": "spiking", "full": "spiking, `--mode=full`"}
INTERRUPTED = 130  # the status of `imitate` after Ctrl-C
HEADER = (
    *("environment", "policy", "random", "expert", "best line", "best baseline", "float32", "integers"),
    *("spikes", "of the way", "minutes"),
)


def short_name(environment):
    """Returns Spring for hidden_state:Spring-v0."""
    return re.sub(r"-v\d+$", "", environment.rpartition(":")[2])


def command(environment, mode, *further):
    """Returns the command of a run as the page prints it. Spiking is the default."""
    flags = [] if mode == "baseline" else [f"--mode={mode}"]
    return ["-m", "spikeserve", "imitate", environment, f"--expert={ROWS[environment]}", *flags, *further]


def folder_of(out, environment, mode):
    return out / f"{short_name(environment)}-{mode}"


def train(out, environment, mode, flags):
    """Runs a command, and appends its processor time to OUT/processor.jsonl. Returns whether it succeeded."""
    folder = folder_of(out, environment, mode)
    if (folder / "metadata.json").is_file():
        return True
    arguments = command(environment, mode, f"--out={folder}", *flags)
    print(shlex.join(["python", *arguments]), flush=True)
    begin = time.monotonic()
    with (out / f"{folder.name}.log").open("ab") as log:
        process = subprocess.Popen([sys.executable, *arguments], stdout=log, stderr=log)
        status, usage = wait(process.pid)
    record = {
        "run": folder.name,
        "status": os.waitstatus_to_exitcode(status),
        "wall": round(time.monotonic() - begin),
        "processor": round(usage.ru_utime + usage.ru_stime),
    }
    with (out / "processor.jsonl").open("a") as times:
        times.write(json.dumps(record) + "\n")
    print(json.dumps(record), flush=True)
    if record["status"] == INTERRUPTED:
        sys.exit(INTERRUPTED)
    return record["status"] == 0


def wait(process):
    """Returns the status of a process, and its usage with the trainings that it waited for.

    Ctrl-C reaches the process, too, which then ends by itself.
    """
    while True:
        try:
            return os.wait4(process, 0)[1:]
        except KeyboardInterrupt:
            pass


def processor_seconds(out, run):
    """Returns the processor seconds of all tries of a run."""
    records = map(json.loads, (out / "processor.jsonl").read_text().splitlines())
    return sum(record["processor"] for record in records if record["run"] == run)


def shown(returns):
    """Returns mean ± standard error."""
    mean, error = np.mean(returns), np.std(returns) / np.sqrt(len(returns))
    digits = 1 if abs(mean) >= 10 else 2
    return f"{mean:.{digits}f} ± {error:.{digits}f}"


def best(figures, prefix=""):
    """Returns the name and the returns of the best baseline whose name begins with `prefix`."""
    named = {name: value["returns"] for name, value in figures.items() if name.startswith(prefix)}
    return max(named.items(), key=lambda item: np.mean(item[1]), default=("", []))


def table_row(out, environment, mode):
    """Returns the cells of a finished run; None if it is not finished."""
    folder = folder_of(out, environment, mode)
    if not (folder / "metadata.json").is_file():
        return None
    metadata = json.loads((folder / "metadata.json").read_text())
    chance = json.loads((folder / "evaluations/chance.json").read_text())["returns"]
    expert, *versions = metadata["figures"].values()  # float32, and integers unless they lost too much; of `dense` the first alone
    returns = [version["returns"] for version in versions]
    share = (np.mean(returns[-1]) - np.mean(chance)) / (np.mean(expert["returns"]) - np.mean(chance))
    _, line = best(metadata["baselines"], "line")
    name, baseline = best(metadata["baselines"])
    return [
        short_name(environment),
        MODES[mode],
        shown(chance),
        shown(expert["returns"]),
        shown(line),
        f"{shown(baseline)} ({name})",
        shown(returns[0]),
        shown(returns[1]) if returns[1:] else "",
        "" if mode == "dense" else f"{versions[-1]['spikes_per_decision']:.0f}",
        f"{share:.1%}",
        f"{processor_seconds(out, folder.name) / 60:.0f}",
    ]


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", required=True, type=pathlib.Path)
    parser.add_argument("--modes", default="dense,baseline")
    parser.add_argument("--rows", help="short names, such as Spring; default: all")
    parser.add_argument("--flags", default="", help="further flags of every run, in one string")
    parser.add_argument("--print", action="store_true")
    arguments = parser.parse_args(arguments)
    out, modes = arguments.out.resolve(), arguments.modes.split(",")
    environments = {short_name(environment): environment for environment in ROWS}
    names = arguments.rows.split(",") if arguments.rows else list(environments)
    if arguments.print:
        print("| " + " | ".join(HEADER) + " |")
        print("|" + " --- |" * 2 + " ---: |" * (len(HEADER) - 2))
        cells = [table_row(out, environments[name], mode) for name in names for mode in modes]
        for row in filter(None, cells):
            print("| " + " | ".join(row) + " |")
        return 0
    out.mkdir(parents=True, exist_ok=True)
    flags = shlex.split(arguments.flags)
    done = [train(out, environments[name], mode, flags) for mode in modes for name in names]
    return 0 if all(done) else 1


if __name__ == "__main__":
    sys.exit(main())
