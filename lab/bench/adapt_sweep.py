#!/usr/bin/env python3
"""Runs `spikectl adapt` for many seeds and prints the result of each, their medians and their range.

usage: lab/bench/adapt_sweep.py --bin=build/release/bin [--seeds=10] [--jobs=2] FLAG...

Every FLAG goes to `spikectl adapt`. For example, --env=CartPole-v1 --perturb=force=-1 --episodes=60 is one row of
lab/evidence/online-learning.md. Each seed has its own server. No two seeds share an initial state.
"""

import argparse
import concurrent.futures
import json
import pathlib
import statistics
import subprocess
import sys

import programs

POLICIES = pathlib.Path(__file__).parents[2] / "deploy/policies"
STRIDE = 10_000_000  # more reset seeds than one run of spikectl adapt uses


def adapt(arguments, flags, seed):
    """Returns the report of `spikectl adapt` for one seed."""
    served = [arguments.bin / "spikeserve", f"--policies={arguments.policies}", "--listen=127.0.0.1:0", "--http_listen="]
    with programs.running_server(served, programs.SPIKESERVE, programs.ALL_CORES) as server:
        command = [arguments.bin / "spikectl", "adapt", f"--server={server.address}", f"--seed={seed * STRIDE}", "--json"]
        return json.loads(subprocess.run([*command, *flags], check=True, stdout=subprocess.PIPE).stdout)


def regained(result):
    """Returns the regained share of the lost return. None if the perturbation lost no return."""
    lost = result["unperturbed_return"] - result["frozen_return"]
    return (result["adapted_return"] - result["frozen_return"]) / lost if lost > 0 else None


def describe(name, results):
    def median(key):
        return statistics.median(result[key] for result in results)

    shares = [regained(result) for result in results]
    text = f"{name}: unperturbed {median('unperturbed_return'):.1f}, frozen {median('frozen_return'):.1f}, "
    text += f"adapted {median('adapted_return'):.1f}"
    if None not in shares:
        text += f", regained {statistics.median(shares):.0%}"
    return text + f", drift {median('head_drift'):.2f}, rollbacks {sum(r['rollbacks'] for r in results)}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="folder of the programs")
    parser.add_argument("--policies", type=pathlib.Path, default=POLICIES)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first_seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="number of seeds that run concurrently")
    arguments, flags = parser.parse_known_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    results = []
    with concurrent.futures.ThreadPoolExecutor(arguments.jobs) as executor:
        for seed, result in zip(seeds, executor.map(lambda s: adapt(arguments, flags, s), seeds), strict=True):
            print(describe(f"seed {seed}", [result]), flush=True)
            results.append(result)
    print(describe("median", results))
    adapted = [result["adapted_return"] for result in results]
    shares = [share for share in map(regained, results) if share is not None]
    half = f"; {sum(share >= 0.5 for share in shares)} of {len(shares)} regained half" if shares else ""
    print(f"adapted: least {min(adapted):.1f}, most {max(adapted):.1f}{half}")


if __name__ == "__main__":
    sys.exit(main())
