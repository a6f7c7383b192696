"""Writes docs/evidence/microcontrollers.md: what policies cost on a processor, beside a dense transformer and a perceptron.

usage: make lab-chips, or with the variables that the tests of lab/tests have: python lab/microcontrollers/costs.py

Every model is compiled and run in QEMU, which compares what it decides with the engine of the server.
"""

import concurrent.futures
import os
import pathlib
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace

HERE = pathlib.Path(__file__).parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT / "tests/microcontroller")]

from emitted import emit, name_of, run, shipped
from emulated import CHIPS

DECISIONS = 30
PICOJOULES_A_CYCLE = 300
PAGE = ROOT / "docs/evidence/microcontrollers.md"
# Classic control, of which a perceptron of 64 and 64 neurons returns as much.
PERCEPTRONS = ("cartpole-small-1", "mountaincar-1", "pendulum-1")
RUNS = (("cortex-m0plus", "-Os"), ("cortex-m4", "-Os"), ("cortex-m4", "-O3"))
FLASH, RAM = 512 << 10, 256 << 10  # of the M7 of which the page says what fits
TEXT = """# Policies on microcontrollers

**On a processor, spiking does not pay where something small is enough.** A perceptron with two hidden layers of 64 in int8, which plays
CartPole at 500 as well, needs {tiny} instructions for a decision on a Cortex-M4 and {tiny_flash} bytes of flash; `cartpole-small` needs
{small} and {small_flash}, and the policies of MountainCar and Pendulum {larger} times the instructions of the perceptron, which returns as
much there, or a few points less. A line plays CartPole, too ([what it costs](cost.md)). **Beside a dense int8 transformer of the same size** a spiking policy
needs {plain_ratios} times the instructions if both are plain loops, and {pairs_ratios} times if the dense one uses the processor's
instructions for two products: {dearer}. By the account of a circuit it takes {circuit_ratios} times the energy of the dense one,
with memory {memory_ratios} times.

`make lab-chips` writes this page: the first {decisions} decisions of a session in QEMU, compared bit for bit with the engine's; classic control
is played, the other policies get random observations. The policies are the C of [emit-c](../guides/microcontroller.md), with a
session that moves, learned heads and all counts. `dense` has the sizes of the policy above it, random weights, which do not change its
cost, and neither a session nor a table of timesteps ([dense.c](../../lab/microcontrollers/dense.c)); libraries of hand-written kernels
would need fewer instructions for it than `pairs`.

## Costs

Flash (code, tables, and the compiler's library), RAM (state) and stack, which was painted, are of a Cortex-M4 with `-Os`. Instructions are
those of a decision, mean of {decisions}, by QEMU's own count. It counts no cycles: by Arm's manuals most instructions of a
Cortex-M0+ and M4 take one, loads and taken branches two or three, so that a decision takes one to two cycles for each instruction. At
100 µA/MHz and 3 V (data sheet of the STM32L476) a cycle is {cycle} pJ: the column in µJ has one and two cycles for each
instruction on M4 with `-Os`. Beside it is the account of the operations, which leaves the processor out, and the same with memory
([energy](../reference/energy.md)).

| model | flash | RAM | stack | M0+ `-Os` | M4 `-Os` | M4 `-O3` | µJ on M4 | nJ by `int_45nm` | `int_sram_45nm` |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
{rows}

The energy of a perceptron's operations is in [the laboratory](../../lab/evidence/paper.md#energy), with its returns.

## What fits

A Cortex-M7 with 512 KB of flash and 256 KB of RAM: {fits}.
"""


@dataclass
class Costs:
    """What a model costs. `energies`, in picojoules, are by int_45nm and int_sram_45nm; of a perceptron none."""

    name: str
    flash: int
    state: int
    stack: int
    instructions: list
    energies: list

    def row(self):
        mean = self.instructions[1]
        joules = f"{mean * PICOJOULES_A_CYCLE / 1e6:,.1f} to {2 * mean * PICOJOULES_A_CYCLE / 1e6:,.1f}"
        counts = " | ".join(f"{count:,}" for count in self.instructions)
        energies = " | ".join(f"{picojoules / 1e3:,.2f}" for picojoules in self.energies) or " | "
        return f"| {self.name} | {self.flash:,} | {self.state:,} | {self.stack:,} | {counts} | {joules} | {energies} |"


def measure(emitted, program):
    """Returns the instructions of a decision by RUNS, and the last answer of a Cortex-M4."""
    instructions, small = [], None
    for chip, level in RUNS:
        answer = CHIPS[chip].run(emitted, level, program=program)
        assert emitted.hash in (None, answer[0]), (chip, level)
        instructions.append(int(answer[1], 16))
        if (chip, level) == ("cortex-m4", "-Os"):
            small = [int(number, 16) for number in answer]
    return instructions, small


def spiking(name, emitted):
    instructions, answer = measure(emitted, "chip_play.c")
    flash = CHIPS["cortex-m4"].flash(emitted, "calls_all.c")
    return Costs(f"`{name}`", flash, emitted.sizes["state_bytes"], answer[3], instructions, answer[4:6])


def make_dense(file, emitted):
    """Writes the tables of the dense baseline of a policy beside its C, and another stream. Returns what dense.c answers to it, and
    the energies in picojoules."""
    answers = run(os.environ["DENSE_BASELINE_PROGRAM"], file, DECISIONS, emitted.folder).split()
    return replace(emitted, hash=answers[0].zfill(16)), [int(number) for number in answers[1:]]


def dense(emitted, energies, name, source):
    instructions, answer = measure(emitted, HERE / source)
    flash = CHIPS["cortex-m4"].flash(emitted, HERE / source)
    return Costs(name, flash, answer[4], answer[3], instructions, energies)


def perceptron(emitted):
    """`emitted` has the sizes of the task."""
    instructions, answer = measure(replace(emitted, hash=None), HERE / "perceptron.c")
    flash = CHIPS["cortex-m4"].flash(emitted, HERE / "perceptron.c")
    return Costs("perceptron", flash, 0, answer[3], instructions, [])


def missing(emitted):
    """Returns what a Cortex-M7 of FLASH and RAM lacks, as the linker says; empty: nothing."""
    chip = replace(CHIPS["cortex-m7"], memory=(0, FLASH, 0x20000000, RAM))
    try:
        chip.link(emitted, "-Os", program="calls_all.c")
    except subprocess.CalledProcessError as error:
        return [line.split("ld: ")[-1] for line in error.stderr.splitlines() if "overflowed" in line]
    return []


def models_of(file):
    """Returns the costs of a policy, its twins and a perceptron, and what a large chip lacks for the policy."""
    name = name_of(file)
    with tempfile.TemporaryDirectory() as folder:
        emitted = emit(file, folder, DECISIONS)
        models = [spiking(name, emitted)]
        twin, energies = make_dense(file, emitted)
        models.append(dense(twin, energies, "dense", "dense.c"))
        models.append(dense(twin, energies, "dense, pairs", "dense_pairs.c"))
        if name in PERCEPTRONS:
            models.append(perceptron(emitted))
        print(*(model.row() for model in models), sep="\n", flush=True)
        return models, [f"`{name}` does not, {lack}" for lack in missing(emitted)]


def ratios(numbers):
    least, most = (float(f"{number:.2g}") for number in (min(numbers), max(numbers)))
    return f"{least:g} to {most:g}"


def sentences(measured):
    """Returns what the page says of all models."""
    small, _, _, tiny = measured[0]
    values = {"decisions": DECISIONS, "cycle": PICOJOULES_A_CYCLE}
    for name, model in (("small", small), ("tiny", tiny)):
        values |= {name: f"{model.instructions[1]:,}", f"{name}_flash": f"{model.flash:,}"}
    by_pairs = {models[0].name: models[0].instructions[1] / models[2].instructions[1] for models in measured}
    dearer = [name for name, ratio in by_pairs.items() if ratio > 1]
    return values | {
        "larger": ratios([models[0].instructions[1] / models[3].instructions[1] for models in measured[1:] if len(models) > 3]),
        "plain_ratios": ratios([models[0].instructions[1] / models[1].instructions[1] for models in measured]),
        "pairs_ratios": ratios(by_pairs.values()),
        "dearer": f"more for {', '.join(dearer)}" if dearer else "never more",
        "circuit_ratios": ratios([models[0].energies[0] / models[1].energies[0] for models in measured]),
        "memory_ratios": ratios([models[0].energies[1] / models[1].energies[1] for models in measured]),
    }


def main():
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        measured, lacks = zip(*pool.map(models_of, shipped()), strict=True)
    fits = "; ".join(lack for policy in lacks for lack in policy) or f"all {len(measured)} shipped policies fit, linked with all seven functions"
    rows = "\n".join(model.row() for models in measured for model in models)
    PAGE.write_text(TEXT.format(**sentences(measured), fits=fits, rows=rows))


if __name__ == "__main__":
    main()
