"""Measures every contestant of the benchmark and writes one JSON file and one Markdown page.

Every round measures all contestants one after the other, so that load on the machine affects all of them. A result is
the median over the rounds. A ratio is the median of the ratios within a round.
"""

import argparse
import contextlib
import json
import os
import pathlib
import platform
import statistics
import subprocess
import sys
import tempfile
import time

import programs
import report

ROOT = pathlib.Path(__file__).parents[2]
BENCH = pathlib.Path(__file__).parent
POLICIES = ROOT / "deploy/policies"
SHIPPED = POLICIES / "cartpole/1/policy.safetensors"

SESSIONS = [1, 8, 64, 512]
BATCH = 64  # requests
# Bound of the initial states of CartPole. The shipped policy was trained to emit few spikes there.
OBSERVATION_BOUND = 0.05


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="folder of the programs")
    parser.add_argument("--python", type=pathlib.Path, required=True, help="a Python with the packages of requirements.txt")
    parser.add_argument("--json", type=pathlib.Path, required=True, help="output file for programs")
    parser.add_argument("--markdown", type=pathlib.Path, required=True, help="output file for readers")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=1.0, help="seconds for each contestant in a round")
    parser.add_argument("--max_sessions", type=int, default=1_000_000, help="largest number of open sessions")
    sections = ["engine", "growth", "sessions", "server", "learning"]
    parser.add_argument("--sections", nargs="+", choices=sections, default=sections)
    return parser.parse_args()


def summarize(rounds):
    """Returns the median of every key over the rounds, which are dicts of numbers."""
    return {key: statistics.median(r[key] for r in rounds) for key in rounds[0]}


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
        "spikeserve_silent_int8": [engine, shipped, "--arithmetic=int8"],
        "spikeserve_loud_int8": [engine, "--arithmetic=int8"],
        "spikeserve_silent_together": [engine, shipped, f"--together={BATCH}"],
        "spikeserve_loud_together": [engine, f"--together={BATCH}"],
        "reference": [engine, shipped, "--engine=reference", "--episode_steps=20"],
        "torch_snn_window": [torch, "--model=snn", shipped],
        "torch_dense_window": [torch, "--model=dense"],
        "torch_dense_cached": [torch, "--model=dense_cached"],
        "onnx_dense_cached": [arguments.python, BENCH / "dense_onnx.py", dense, dense_logits],
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
    commands = {
        f"{flag}={value}": [engine, f"--{flag}={value}", f"--episode_steps={4 * value if flag == 'context' else 500}"]
        for flag, values in variants.items()
        for value in values
    }
    for steps in [20, 100, 500, 10_000]:
        commands[f"episode_steps={steps}"] = [engine, f"--policy={SHIPPED}", f"--episode_steps={steps}"]
    return commands


def measure_sessions(arguments):
    """Measures the memory of a session for growing numbers of sessions."""
    counts = [n for n in (1, 1000, 100_000, 1_000_000) if n <= arguments.max_sessions]
    results = []
    for count in counts:
        command = [arguments.bin / "session_bench", f"--policy={SHIPPED}", f"--sessions={count}"]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        results.append(json.loads(output))
    return results


def load_flags(mode, sessions):
    """Returns the flags of spikeload for a mode. A batch holds BATCH requests, or all sessions if there are fewer."""
    streams = -(-sessions // BATCH) if mode == "batch" else min(8, sessions)
    flags = {"mode": mode, "sessions": sessions, "streams": streams}
    return {**flags, "policy": SHIPPED.parts[-3], "observation_bound": OBSERVATION_BOUND}


def running_spikeserve(arguments):
    command = [arguments.bin / "spikeserve", f"--policies={POLICIES}", "--listen=127.0.0.1:0", "--http_listen="]
    return programs.running_server(command, "spikeserve: serving gRPC on ")


@contextlib.contextmanager
def running_servers(arguments):
    """Starts spikeserve, the echo service, and the echo service that also runs the engine. Yields them by name."""
    echo = [arguments.bin / "echo_server"]
    with (
        running_spikeserve(arguments) as spikeserve_server,
        programs.running_server(echo, "listening on ") as echo_server,
        programs.running_server([*echo, f"--policy={SHIPPED}"], "listening on ") as deciding_echo,
    ):
        yield {"spikeserve": spikeserve_server, "echo": echo_server, "deciding_echo": deciding_echo}


def measure_learning(arguments):
    """Measures 64 sessions that learn, as a share of 64 frozen sessions in the same round."""
    spikeload, sessions = arguments.bin / "spikeload", 64
    cases = [(mode, scope) for mode in ("unary", "stream") for scope in ("fleet", "session")]
    rounds = {case: [] for case in cases}
    with running_spikeserve(arguments) as server:
        for _ in range(arguments.rounds):
            for mode, scope in cases:
                flags = {**load_flags(mode, sessions), "duration": f"{arguments.seconds}s"}
                frozen = programs.measure_load(spikeload, server, **flags)
                learning = programs.measure_load(spikeload, server, learning_scope=scope, **flags)
                keys = ("decisions_per_second", "processor_seconds_per_decision")
                shares = {f"share_of_{key}": learning[key] / frozen[key] for key in keys}
                rounds[mode, scope].append({**{key: learning[key] for key in keys}, **shares})
    return [
        {"mode": mode, "scope": scope, "sessions": sessions, **summarize(rounds[mode, scope])} for mode, scope in cases
    ]


@contextlib.contextmanager
def running_torch_server(arguments):
    """Starts the Python server."""
    with tempfile.TemporaryDirectory() as stubs:
        proto = ROOT / "proto"
        subprocess.run(
            [arguments.python, "-m", "grpc_tools.protoc", f"-I{proto}", f"--python_out={stubs}"]
            + [f"--grpc_python_out={stubs}", proto / "spikeserve/v1/policy_service.proto"],
            check=True,
        )
        command = [arguments.python, BENCH / "torch_server.py", SHIPPED, stubs]
        with programs.running_server(command, "listening on ") as server:
            yield server


def share(measured, case, key, name="spikeserve", of="echo"):
    """Returns the median over rounds of the ratio of `key` between the servers `name` and `of`."""
    pairs = zip(measured[name][case], measured[of][case], strict=True)
    return statistics.median(ours[key] / theirs[key] for ours, theirs in pairs)


def measure_servers(arguments):
    """Measures closed-loop rates by mode and sessions, then latencies at half of the peak rate of spikeserve."""
    rounds, spikeload = min(arguments.rounds, 3), arguments.bin / "spikeload"
    duration, cost = f"{arguments.seconds}s", "processor_seconds_per_decision"
    cases = [(mode, sessions) for mode in ("unary", "stream", "batch") for sessions in SESSIONS]
    names = ("spikeserve", "echo")
    bound_cases = [("unary", 64), ("stream", 64)]
    measured = {name: {case: [] for case in cases} for name in names}
    measured["deciding_echo"] = {case: [] for case in bound_cases}
    half = {mode: {name: [] for name in names} for mode in ("unary", "stream")}
    with running_servers(arguments) as servers:

        def load(name, mode, sessions, **flags):
            flags = {**load_flags(mode, sessions), "duration": duration, **flags}
            return programs.measure_load(spikeload, servers[name], **flags)

        for _ in range(rounds):
            for case in cases:
                for name, results in measured.items():
                    if case in results:
                        results[case].append(load(name, *case))
        sessions = SESSIONS[-1]
        for mode, results in half.items():
            peak = summarize(measured["spikeserve"][mode, sessions])["decisions_per_second"]
            for _ in range(rounds):
                for name in names:
                    results[name].append(load(name, mode, sessions, rate=peak / 2))
    return {
        "closed_loop": [
            {
                "mode": mode,
                "sessions": sessions,
                **{name: summarize(measured[name][mode, sessions]) for name in names},
                "share_of_echo": share(measured, (mode, sessions), "decisions_per_second"),
                "processor_share_of_echo": 1 / share(measured, (mode, sessions), cost),
            }
            for mode, sessions in cases
        ],
        "bounds": [
            {
                "mode": mode,
                "sessions": sessions,
                **{name: summarize(results[mode, sessions]) for name, results in measured.items()},
                "share_at_best": 1 / share(measured, (mode, sessions), cost, name="deciding_echo"),
                "share_reached": 1 / share(measured, (mode, sessions), cost),
                "share_of_deciding_echo": 1 / share(measured, (mode, sessions), cost, of="deciding_echo"),
            }
            for mode, sessions in bound_cases
        ],
        "half_peak": [
            {"mode": mode, "sessions": sessions, **{name: summarize(results[name]) for name in names}}
            for mode, results in half.items()
        ],
    }


def measure_torch_server(arguments):
    with running_torch_server(arguments) as server:
        return [
            {
                "sessions": sessions,
                **programs.measure_load(
                    arguments.bin / "spikeload",
                    server,
                    **load_flags("unary", sessions),
                    duration=f"{2 * arguments.seconds}s",
                ),
            }
            for sessions in SESSIONS[:3]
        ]


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

    section("engine", lambda: measure_engines(arguments))
    section("growth", lambda: run_contestants(growth_contestants(arguments), arguments.rounds, arguments.seconds / 2))
    section("sessions", lambda: measure_sessions(arguments))
    section("server", lambda: {**measure_servers(arguments), "torch_server": measure_torch_server(arguments)})
    section("learning", lambda: measure_learning(arguments))
    result["duration_seconds"] = time.monotonic() - start
    arguments.json.write_text(json.dumps(result, indent=2) + "\n")
    arguments.markdown.write_text(report.to_markdown(result))


if __name__ == "__main__":
    main()
