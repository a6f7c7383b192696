#!/usr/bin/env python3
"""Compares spikeserve on its two transports with gRPC's empty echo, in interleaved rounds.

Prints a Markdown table: microseconds of processor time a call, the rate, and the 99th percentile of the latency as the
client sees it, each the median over the rounds, and the median ratio of the rate to the echo's in the same round. The
server has one core, the load generator the others; where the machine has two, the generator limits the rates.

    python3 loadtest/bench/transport_bench.py --bin=build/release/bin
"""

import argparse
import contextlib
import pathlib
import statistics

import programs

ROOT = pathlib.Path(__file__).parents[2]
CASES = [("unary", 8), ("unary", 64), ("stream", 64)]


def servers(arguments):
    serve = [arguments.bin / "spikeserve", f"--policies={ROOT / 'deploy/policies'}", "--listen=127.0.0.1:0"]
    serve += ["--http_listen=", "--loops=1"]
    announcement = "spikeserve: serving gRPC on "
    return {
        "gRPC's echo": programs.running_server([arguments.bin / "echo_server"], "listening on "),
        "spikeserve, gRPC": programs.running_server([*serve, "--transport=grpc"], announcement),
        "spikeserve, nghttp2": programs.running_server([*serve, "--transport=nghttp2"], announcement),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bin", type=pathlib.Path, default=ROOT / "build/release/bin")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0)
    arguments = parser.parse_args()
    measured = {}
    with contextlib.ExitStack() as stack:
        running = {name: stack.enter_context(server) for name, server in servers(arguments).items()}
        for _ in range(arguments.rounds):
            for mode, sessions in CASES:
                for name, server in running.items():
                    flags = {"mode": mode, "sessions": sessions, "streams": min(8, sessions), "policy": "cartpole"}
                    flags |= {"observation_bound": 0.05, "duration": f"{arguments.seconds}s"}
                    result = programs.measure_load(arguments.bin / "spikeload", server, **flags)
                    measured.setdefault((mode, sessions, name), []).append(result)
    print("| | server | processor µs a call | calls a second | p99, ms | rate, times the echo's |")
    print("| --- | --- | ---: | ---: | ---: | ---: |")
    for (mode, sessions, name), rounds in measured.items():
        echo = measured[mode, sessions, "gRPC's echo"]
        cost = statistics.median(r["processor_seconds_per_decision"] for r in rounds) * 1e6
        rate = statistics.median(r["decisions_per_second"] for r in rounds)
        p99 = statistics.median(r["p99_seconds"] for r in rounds) * 1e3
        pairs = zip(rounds, echo, strict=True)
        ratio = statistics.median(r["decisions_per_second"] / e["decisions_per_second"] for r, e in pairs)
        print(f"| {mode}, {sessions} sessions | {name} | {cost:.1f} | {rate:,.0f} | {p99:.2f} | {ratio:.2f} |")


if __name__ == "__main__":
    main()
