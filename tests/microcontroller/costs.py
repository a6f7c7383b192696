"""Writes docs/evidence/microcontrollers.md: what the C of the shipped policies costs on a processor.

usage: SPIKECTL_PROGRAM=build/release/bin/spikectl CHIP_STREAM_PROGRAM=build/release/tests/chip_stream \
         python3 tests/microcontroller/costs.py

Runs the smallest policies in QEMU, and takes the sizes of the others from what `spikectl emit-c` prints.
"""

import tempfile

from emitted import ROOT, emit, name_of, shipped
from emulated import CHIPS

MEASURED = 2
DECISIONS = 100
PICOJOULES_A_CYCLE = 300
PAGE = ROOT / "docs/evidence/microcontrollers.md"
TEXT = """# Policies on microcontrollers

`python3 tests/microcontroller/costs.py` writes this page from {decisions} decisions of each measured policy in QEMU, whose answers are
compared with the server's, and the C of [emit-c](../guides/microcontroller.md) compiled with `-Os`.

**On a processor, a perceptron is cheaper.** With two hidden layers of 64 in int8, compiled by the same compiler, it needs
{perceptron:,} instructions on a Cortex-M4 for a decision of CartPole, and {perceptron_flash:,} bytes of flash; `cartpole-small` needs
{instructions:,} and {flash:,}. For a return of 500 even a line is enough ([what it costs](cost.md)). A multiplication costs these processors no more than
the addition that a spike needs, and a decision of a policy computes three tokens over its context. A dense decision transformer has no C yet.

## Instructions

QEMU counts instructions and no cycles. A Cortex-M4 takes one to two cycles for each, because of branches, divisions and waiting for the
flash. At 100 µA/MHz and 3 V (data sheet of the STM32L476) a cycle is {cycle} pJ: the column in µJ has one and two cycles. Beside it is the
account of the operations alone ([energy](../reference/energy.md)), which leaves the processor out. The most is the first decision
of a session that has moved, which computes the tokens of its history.

| policy | a decision on M0+ | on M4 | the most on M4 | µJ on M4 | nJ by `int_45nm` |
| --- | --- | --- | --- | --- | --- |
{decision_rows}

## Memory

On a Cortex-M4, with all seven functions and what they need of the compiler's library, `cartpole-small` has {flash:,} bytes of flash, of which
{tables:,} are its tables, and {stack:,} bytes of stack. The code of a policy with all parts has {code:,} bytes. A Cortex-M7 with 512 KB of
flash and 256 KB of RAM holds every policy of which "fits" is yes.

| policy | tables, bytes of flash | state, bytes of RAM | fits |
| --- | --- | --- | --- |
{memory_rows}
"""


def measure(file, folder):
    """Returns the C of a policy, its code on a Cortex-M4 with its tables, and what chip_play.c prints by chip."""
    emitted = emit(file, folder, DECISIONS)
    answers = {}
    for chip in ("cortex-m4", "cortex-m0plus"):
        answer = CHIPS[chip].run(emitted, "-Os")
        assert answer[0] == emitted.hash
        answers[chip] = [int(number, 16) for number in answer[1:]]
    return emitted, CHIPS["cortex-m4"].flash(emitted), answers


def main():
    values, decisions, memory = {"decisions": DECISIONS, "cycle": PICOJOULES_A_CYCLE}, [], []
    for number, file in enumerate(shipped()):
        with tempfile.TemporaryDirectory() as folder:
            if number >= MEASURED:
                emitted = emit(file, folder, decisions=1)
            else:
                emitted, flash, answers = measure(file, folder)
                mean, most, stack, picojoules = answers["cortex-m4"]
                joules = f"{mean * PICOJOULES_A_CYCLE / 1e6:.1f} to {2 * mean * PICOJOULES_A_CYCLE / 1e6:.1f}"
                counts = f"{answers['cortex-m0plus'][0]:,} | {mean:,} | {most:,}"
                decisions.append(f"| `{name_of(file)}` | {counts} | {joules} | {picojoules / 1e3:,.2f} |")
                values["code"] = flash - emitted.sizes["table_bytes"]
            tables, state = emitted.sizes["table_bytes"], emitted.sizes["state_bytes"]
            if number == 0:
                values |= {"flash": flash, "tables": tables, "instructions": mean, "stack": stack}
                values["perceptron"] = int(CHIPS["cortex-m4"].run(emitted, "-Os", program="perceptron.c")[1], 16)
                values["perceptron_flash"] = CHIPS["cortex-m4"].flash(emitted, "perceptron.c")
        fits = tables + values["code"] <= 512 << 10 and state + values["stack"] <= 256 << 10
        memory.append(f"| `{name_of(file)}` | {tables:,} | {state:,} | {'yes' if fits else 'no'} |")
    PAGE.write_text(TEXT.format(**values, decision_rows="\n".join(decisions), memory_rows="\n".join(memory)))


if __name__ == "__main__":
    main()
