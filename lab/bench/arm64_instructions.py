"""Counts the arm64 instructions of a decision with qemu, and writes arm64_instructions.json, which report.py prints.

An emulator shows nothing about time, but the same instructions run on a robot. The difference of a long and a short run
leaves out what starts the program. Needs Debian's package qemu-user (qemu-user-static has no plugins) and engine_bench in
build/arm64/bin.
"""

import json
import pathlib
import re
import subprocess
import sys
import tempfile

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))
from past_policies import past_policy  # noqa: E402

ROOT = pathlib.Path(__file__).parents[2]
RESULT = pathlib.Path(__file__).with_suffix(".json")
BENCH = ROOT / "build/arm64/bin/engine_bench"
PROCESSORS = {"cortex-a72": "Raspberry Pi 4", "cortex-a76": "Raspberry Pi 5"}
POLICIES = {
    "cartpole/1, float32": [f"--policy={past_policy('cartpole', 1)}"],
    "cartpole/2, 8-bit weights": [f"--policy={past_policy('cartpole', 2)}"],
    "random weights, 8-bit": ["--arithmetic=int8"],
}
SECONDS = (0.5, 1.5)  # of processor time, emulated


def run(plugin, processor, flags, seconds):
    """Returns the decisions of one run, and its instructions by function."""
    command = ["qemu-aarch64", "-cpu", processor, "-L", ROOT / "build/arm64-root", "-plugin", plugin, "-d", "plugin"]
    finished = subprocess.run(
        [*command, BENCH, *flags], input=f"{seconds}\n", cwd=ROOT, capture_output=True, text=True, check=True
    )
    decisions = json.loads(finished.stdout.splitlines()[1])["decisions"]
    counted = re.findall(r"^instructions (\d+) (.*)$", finished.stdout + finished.stderr, re.MULTILINE)
    return decisions, {symbol: int(number) for number, symbol in counted}


def measure(plugin, processor, flags):
    """Returns the instructions of a decision, and the share of the map of spike counts in them."""
    (few, start), (many, end) = (run(plugin, processor, flags, seconds) for seconds in SECONDS)
    per_decision = {symbol: (number - start.get(symbol, 0)) / (many - few) for symbol, number in end.items()}
    if "--verbose" in sys.argv:
        for symbol, number in sorted(per_decision.items(), key=lambda item: -item[1])[:15]:
            print(f"{number:12.0f} {symbol}", file=sys.stderr)
    total = sum(per_decision.values())
    affine = sum(number for symbol, number in per_decision.items() if "Affine" in symbol or "sdot" in symbol.lower())
    return total, affine


def main():
    with tempfile.TemporaryDirectory() as folder:
        plugin = pathlib.Path(folder, "count_instructions.so")
        source = pathlib.Path(__file__).with_name("count_instructions.c")
        subprocess.run(["gcc", "-shared", "-fPIC", "-O2", "-o", plugin, source], check=True)
        rows = []
        for name, flags in POLICIES.items():
            for processor, computer in PROCESSORS.items():
                total, affine = measure(plugin, processor, flags)
                row = {"policy": name, "processor": f"{processor} ({computer})"}
                rows.append(row | {"instructions": round(total), "instructions_of_maps": round(affine)})
                print(rows[-1], flush=True)
    RESULT.write_text(json.dumps(rows, indent=1) + "\n")



if __name__ == "__main__":
    main()
