"""Measures what a training step of each mode takes, forward, backward and the optimiser, at the paper's size with one thread.

    python lab/study/step_time.py --spiketrain=build/release/bin/spiketrain --work=build/step_time

A figure is the processor time of a long run without that of a short one, by their difference in steps, so starting and
reading are left out. Modes alternate within a round, and the table has medians of rounds. An epoch is that of the paper's
table 1: 10,000 steps, of which a tenth is held out, in batches of 64 clips of 20. Joules are those of the processor's own
counter (powercap), where the system shows one; they count whatever else runs meanwhile.
"""

import argparse
import os
import pathlib
import resource
import statistics
import subprocess

import study_plan
import study_tasks
from study_tables import row

SHORT, LONG = 2, 12  # steps
COUNTER = pathlib.Path("/sys/class/powercap/intel-rapl:0/energy_uj")
SILENT = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
SETTINGS = study_tasks.SETTINGS["table1"]


def joules():
    """Returns the joules of the processor so far; None if the system has no counter that may be read."""
    try:
        return int(COUNTER.read_text()) / 1e6
    except OSError:
        return None


def spent(command):
    """Runs a command. Returns its processor time in seconds, and the joules meanwhile."""
    before, energy = resource.getrusage(resource.RUSAGE_CHILDREN), joules()
    subprocess.run(command, check=True, **SILENT, env={**os.environ, "OMP_NUM_THREADS": "1"})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return seconds, None if energy is None else joules() - energy


def difference(long, short):
    return None if long is None or short is None else (long - short) / (LONG - SHORT)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spiketrain", required=True)
    parser.add_argument("--work", required=True, type=pathlib.Path, help="folder of data and policies")
    parser.add_argument("--rounds", default=5, type=int)
    parser.add_argument("--smoke", action="store_true", help="tiny models: a test in seconds")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    data = arguments.work / "data.cbor"
    if not data.exists():
        number = study_plan.SMOKE.steps if arguments.smoke else study_tasks.STEPS_OF_THE_PAPER
        recorded = ("dataset", "--env=CartPole-v1", f"--steps={number}", "--expert_fraction=0.5")
        subprocess.run([arguments.spiketrain, *recorded, f"--out={data}"], check=True, **SILENT)
    files = (f"--data={data}", f"--out={arguments.work}/policy", "--overwrite")
    sizes = (*SETTINGS.flags, *(study_plan.SMOKE.further if arguments.smoke else ()))

    def run(mode, steps):
        flags = (*sizes, f"--mode={mode}", f"--iterations={steps}", "--validate_every=1000")
        return spent([arguments.spiketrain, "train", *files, *study_plan.without_repetition([*study_plan.COMMON, *flags])])

    steps = {mode: [] for mode in study_plan.MODES}
    for _ in range(arguments.rounds):
        for mode, found in steps.items():
            found.append(tuple(map(difference, run(mode, LONG), run(mode, SHORT))))
    print(row(["mode", "a step, ms", "of `baseline`'s", "an epoch, s", "an epoch, J"]))
    print(row(["---"] + ["---:"] * 4))
    baseline = statistics.median(seconds for seconds, _ in steps["baseline"])
    for mode, found in steps.items():
        times = sorted(seconds for seconds, _ in found)
        middle = statistics.median(times)
        energies = [energy for _, energy in found if energy is not None]
        energy = f"{SETTINGS.epoch * statistics.median(energies):.1f}" if energies else "no counter"
        times_of = f"{1e3 * middle:.0f} ({1e3 * times[0]:.0f} to {1e3 * times[-1]:.0f})"
        print(row([f"`{mode}`", times_of, f"{middle / baseline:.2f}", f"{SETTINGS.epoch * middle:.1f}", energy]))


if __name__ == "__main__":
    main()
