"""Prints the processor time of a call by part, for the echo service and for spikeserve, as a Markdown table.

usage: profile_calls.py --bin=build/release/bin [--mode=unary] [--sessions=64] [--rate=0] [--rounds=7] [--seconds=1]

Needs perf of Linux and the permission to use it. The library and symbol of a sample decide its part. So the time of HTTP/2
and protobuf in malloc, memcpy and locks counts as libraries. The sampling rate is low, because samples are expensive in
a virtual machine. The policy is the shipped one of CartPole, in int8.
"""

import argparse
import collections
import pathlib
import subprocess
import tempfile

import server_bench

SAMPLES_PER_SECOND = 1000
ENGINE = (
    "hwy::",
    "spikeserve::Attention",
    "spikeserve::ChooseAction",
    "spikeserve::EstimateEnergy",
    "spikeserve::PhaseSpikes",
    "spikeserve::SpikeInput",
    "spikeserve::Standardize",
    "spikeserve::kernels::",
    "StreamingEngine",
    "TokenPass",
)
TRANSPORT = (
    "grpc_core::",
    "grpc::",
    "spikeserve::Acceptor",
    "spikeserve::Connection",
    "spikeserve::EventLoop",
    "spikeserve::GrpcStream",
    "spikeserve::MessageReader",
    "spikeserve::TransportLoop",
    "PlainSocket",
)
PARTS = ["engine", "spikeserve's own", "protobuf", "HTTP/2 and gRPC", "libraries", "kernel"]


def part_of(library, symbol):
    if library.startswith("[kernel"):
        return "kernel"
    transport = "nghttp2" in library or any(name in symbol for name in TRANSPORT)
    if transport or symbol.startswith("[.] grpc"):
        return "HTTP/2 and gRPC"
    if "protobuf" in library or "google::protobuf" in symbol or "spikeserve::v1::" in symbol:
        return "protobuf"
    if any(name in symbol for name in ENGINE):
        return "engine"
    if "prometheus" in library or "spikeserve::" in symbol:
        return "spikeserve's own"
    # The echo links gRPC statically.
    return "HTTP/2 and gRPC" if library == "echo_server" else "libraries"


def shares(recording):
    """Returns the share of each part in the samples."""
    columns = ["--sort=dso,sym", "--fields=overhead,dso,sym", "--field-separator=|"]
    command = ["perf", "report", "--stdio", f"--input={recording}", *columns]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    parts = collections.Counter()
    for line in output.splitlines():
        if line.startswith("#") or line.count("|") < 2:
            continue
        overhead, library, symbol = (column.strip() for column in line.split("|", 2))
        parts[part_of(library, symbol)] += float(overhead.rstrip("%"))
    return {part: percent / sum(parts.values()) for part, percent in parts.items()}


def measure(bench, server, arguments):
    """Returns the microseconds of processor time of a decision by part, and their sum."""
    with tempfile.NamedTemporaryFile() as recording:
        command = ["perf", "record", "-q", "-e", "cpu-clock", "-F", str(SAMPLES_PER_SECOND), "-p", str(server.pid)]
        perf = subprocess.Popen([*command, "-o", recording.name], stderr=subprocess.DEVNULL)
        try:
            load = bench.load(server, arguments.mode, arguments.sessions, rate=arguments.rate)
        finally:
            perf.terminate()
            perf.wait()
        whole = load["processor_seconds_per_decision"] * 1e6
        of = shares(recording.name)
        return {**{part: of.get(part, 0) * whole for part in PARTS}, "together": whole}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bin", type=pathlib.Path, required=True)
    parser.add_argument("--mode", choices=["unary", "stream"], default="unary")
    parser.add_argument("--sessions", type=int, default=64)
    parser.add_argument("--rate", type=float, default=0, help="calls a second; 0: closed loop")
    parser.add_argument("--rounds", type=int, default=7, help="number of rounds; the result is their median")
    parser.add_argument("--seconds", type=float, default=1, help="seconds for each server in a round")
    arguments = parser.parse_args()
    rounds = {"echo": [], "spikeserve": []}
    with server_bench.prepared(arguments) as bench, bench.echo() as echo, bench.spikeserve("int8") as spikeserve:
        for _ in range(arguments.rounds):
            rounds["echo"].append(measure(bench, echo, arguments))
            rounds["spikeserve"].append(measure(bench, spikeserve, arguments))
    columns = [server_bench.summarize(results) for results in rounds.values()]
    print("| µs a call | echo | spikeserve |\n| --- | ---: | ---: |")
    for part in [*PARTS, "together"]:
        print(f"| {part} | " + " | ".join(f"{column[part]:.1f}" for column in columns) + " |")


if __name__ == "__main__":
    main()
