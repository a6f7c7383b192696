"""Measures every contestant of the benchmark and writes one JSON file and one Markdown page.

Every round measures all contestants one after the other, so that load on the machine affects all of them. A result is
the median over the rounds. A ratio is the median of the ratios within a round.
"""

import argparse
import json
import os
import pathlib
import platform
import subprocess
import sys
import tempfile
import time

import fleet_bench
import programs
import report
import server_bench
from server_bench import BATCH, BENCH, SHIPPED, SHIPPED_INTEGER, summarize


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="folder of the programs")
    parser.add_argument("--python", type=pathlib.Path, required=True, help="a Python with the packages of requirements.txt")
    parser.add_argument("--json", type=pathlib.Path, required=True, help="output file for programs")
    parser.add_argument("--markdown", type=pathlib.Path, required=True, help="output file for readers")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=1.0, help="seconds for each contestant in a round")
    parser.add_argument("--max_sessions", type=int, default=1_000_000, help="largest number of open sessions")
    sections = ["engine", "growth", "sessions", "server", "own", "learning", "fleet"]
    parser.add_argument("--sections", nargs="+", choices=sections, default=sections)
    return parser.parse_args()


def run_contestants(commands, rounds, seconds):
    """Returns, by name, the medians of decisions_per_second and spikes_per_decision, and the rate of every round."""
    results = {name: [] for name in commands}
    with programs.running_contestants(commands) as contestants:
        for contestant in contestants:
            contestant.measure(seconds / 10)  # warms up caches and clock frequency
        for _ in range(rounds):
            for contestant in contestants:
                measured = contestant.measure(seconds)
                results[contestant.name].append(
                    {
                        "decisions_per_second": measured["decisions"] / measured["seconds"],
                        "spikes_per_decision": measured["spikes"] / measured["decisions"],
                    }
                )
    return {
        name: {**summarize(rounds), "rates": [r["decisions_per_second"] for r in rounds]}
        for name, rounds in results.items()
    }


def engine_contestants(arguments, folder):
    """Returns the commands by name. Writes the files that they need to `folder`."""
    engine, torch = arguments.bin / "engine_bench", arguments.bin / "torch_bench"
    shipped, dense = f"--policy={SHIPPED}", pathlib.Path(folder) / "dense.safetensors"
    export = [torch, f"--export={dense}"]
    dense_logits = subprocess.run(export, check=True, capture_output=True, text=True).stdout.strip()
    return {
        "spikeserve_silent": [engine, shipped],
        "spikeserve_loud": [engine],
        "spikeserve_silent_integer": [engine, f"--policy={SHIPPED_INTEGER}"],
        "spikeserve_loud_integer": [engine, "--arithmetic=integer"],
        "spikeserve_silent_together": [engine, shipped, f"--together={BATCH}"],
        "spikeserve_loud_together": [engine, f"--together={BATCH}"],
        "reference": [engine, shipped, "--engine=reference", "--episode_steps=20"],
        "torch_snn_window": [torch, "--model=snn", shipped],
        "torch_dense_window": [torch, "--model=dense"],
        "torch_dense_cached": [torch, "--model=dense_cached"],
        "torch_dense_cached_int8": [torch, "--model=dense_cached_int8"],
        "onnx_dense_cached": [arguments.python, BENCH / "dense_onnx.py", dense, dense_logits],
        "onnx_dense_cached_int8": [arguments.python, BENCH / "dense_onnx.py", dense, dense_logits, "--int8"],
    }


def measure_engines(arguments):
    with tempfile.TemporaryDirectory() as folder:
        return run_contestants(engine_contestants(arguments, folder), arguments.rounds, arguments.seconds)


def growth_contestants(arguments):
    engine = arguments.bin / "engine_bench"
    variants = {
        "ticks": [5, 10, 20, 40],
        "context": [20, 50, 100, 1000],
        "hidden_size": [64, 128, 256, 512],
    }
    commands = {}
    for flag, values in variants.items():
        for value in values:
            command = [engine, f"--{flag}={value}", f"--episode_steps={4 * value if flag == 'context' else 500}"]
            commands[f"{flag}={value}"] = command
            if flag != "ticks":
                commands[f"{flag}={value}, integer"] = [*command, "--arithmetic=integer"]
    for steps in [20, 100, 500, 10_000]:
        commands[f"episode_steps={steps}"] = [engine, f"--policy={SHIPPED}", f"--episode_steps={steps}"]
    return commands


def measure_sessions(arguments):
    """Measures the memory of a policy, and that of a session for growing numbers of sessions."""
    # The allocator counts memory that it keeps for small allocations of a thread as allocated.
    exact = os.environ | {"GLIBC_TUNABLES": "glibc.malloc.tcache_count=0"}
    cases = [(n, SHIPPED) for n in (1, 1000, 100_000, 1_000_000) if n <= arguments.max_sessions]
    results = []
    for count, policy in [*cases, (1000, SHIPPED_INTEGER)]:
        command = [arguments.bin / "session_bench", f"--policy={policy}", f"--sessions={count}"]
        output = subprocess.run(command, check=True, capture_output=True, text=True, env=exact).stdout
        results.append({"arithmetic": "integer" if policy == SHIPPED_INTEGER else "float32", **json.loads(output)})
    return results


def machine():
    with open("/proc/cpuinfo") as file:
        model = next(line.split(":")[1].strip() for line in file if line.startswith("model name"))
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "caches": subprocess.run(["lscpu", "--caches=NAME,ONE-SIZE"], capture_output=True, text=True).stdout.split()[2:],
        "kernel": platform.release(),
        "load_before": os.getloadavg()[0],
    }


def main():
    arguments = parse_arguments()
    start = time.monotonic()
    result = {"machine": machine(), "rounds": arguments.rounds, "seconds": arguments.seconds}

    def section(name, measure):
        if name in arguments.sections:
            print(f"bench: {name}", file=sys.stderr, flush=True)
            result[name] = measure()
            # After each section, so that a failure of the next one does not lose it.
            arguments.json.write_text(json.dumps(result, indent=2) + "\n")

    section("engine", lambda: measure_engines(arguments))
    section("growth", lambda: run_contestants(growth_contestants(arguments), arguments.rounds, arguments.seconds / 2))
    section("sessions", lambda: measure_sessions(arguments))
    section("server", lambda: server_bench.measure_servers(arguments))
    section("own", lambda: server_bench.measure_own_observations(arguments))
    section("learning", lambda: server_bench.measure_learning(arguments))
    section("fleet", lambda: fleet_bench.measure_fleet(arguments))
    result["duration_seconds"] = time.monotonic() - start
    arguments.json.write_text(json.dumps(result, indent=2) + "\n")
    arguments.markdown.write_text(report.to_markdown(result))


if __name__ == "__main__":
    main()
