"""Measures the engine, its sessions and the server on this machine, and prints a table: about a minute on an idle machine.

    python3 loadtest/bench.py --bin=build/release/bin

The engine has one core and counts processor time, so other programs hardly change it. The server and the load generator share the
machine. `spikeload --help` has more ways to load a server.
"""

import argparse
import json
import pathlib
import subprocess

POLICIES = pathlib.Path(__file__).parents[1] / "deploy/policies"
POLICY = "cartpole"
VERSIONS = {"baseline": "1", "full": "2"}  # by mode
LOADS = (("unary", 1), ("unary", 64), ("stream", 64), ("batch", 64))


def engine_row(programs, mode, version, seconds):
    command = [programs / "engine_bench", f"--policy={POLICIES / POLICY / version / 'policy.safetensors'}"]
    finished = subprocess.run(command, input=f"{seconds}\n", capture_output=True, check=True, text=True)
    measured = json.loads(finished.stdout.splitlines()[1])  # after "ready"
    rate = measured["decisions"] / measured["seconds"]
    spikes = measured["spikes"] / measured["decisions"]
    return f"engine, {mode}", rate, f"{1e6 / rate:.1f} µs a decision, {spikes:.0f} spikes"


def session_row(programs, sessions=1000):
    policy = POLICIES / POLICY / VERSIONS["full"] / "policy.safetensors"
    command = [programs / "session_bench", f"--policy={policy}", f"--sessions={sessions}"]
    measured = json.loads(subprocess.run(command, capture_output=True, check=True, text=True).stdout)
    active, idle, engine = (measured[f"{name}_bytes"] for name in ("active", "idle", "policy"))
    return "memory, full", None, f"session {active / 1024:.1f} KiB, idle {idle / 1024:.1f} KiB, engine {engine / 1e6:.2f} MB"


def server_rows(programs, seconds):
    command = [programs / "spikeserve", f"--policies={POLICIES}", "--listen=127.0.0.1:0", "--http_listen=", "--loops=1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            address = next(line for line in server.stdout if "serving gRPC on " in line).split()[-1]
            for mode, sessions in LOADS:
                flags = [f"--server={address}", f"--policy={POLICY}", f"--mode={mode}", f"--sessions={sessions}"]
                load = [programs / "spikeload", *flags, f"--duration={seconds}s", "--json"]
                report = json.loads(subprocess.run(load, capture_output=True, check=True, text=True).stdout)
                latency = f"p50 {1e3 * report['p50_seconds']:.2f} ms, p99 {1e3 * report['p99_seconds']:.2f} ms"
                yield f"server, {mode}, {sessions} sessions", report["decisions_per_second"], latency
        finally:
            server.terminate()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="folder of the programs")
    parser.add_argument("--seconds", type=float, default=3, help="seconds of each row")
    arguments = parser.parse_args()
    programs = arguments.bin.resolve()
    print(f"{'policy ' + POLICY:32} {'decisions/s':>12}")
    rows = [engine_row(programs, *item, arguments.seconds) for item in VERSIONS.items()]
    for name, rate, text in [*rows, session_row(programs), *server_rows(programs, arguments.seconds)]:
        print(f"{name:32} {f'{rate:,.0f}' if rate else '':>12}  {text}")


if __name__ == "__main__":
    main()
