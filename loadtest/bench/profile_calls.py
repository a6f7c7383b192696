"""Prints the processor time of a call by part, for spikeserve and both echo services, as a Markdown table.

usage: profile_calls.py --bin=build/release/bin [--mode=unary] [--sessions=64] [--rate=0] [--rounds=7] [--seconds=1]

Needs perf of Linux and the permission to use it. The library and symbol of a sample decide its part. So the time of gRPC
and protobuf in malloc, memcpy and locks counts as libraries. The sampling rate is low, because samples are expensive in
a virtual machine.
"""

import argparse
import collections
import pathlib
import subprocess
import tempfile

import bench
import programs

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
PARTS = ["engine", "spikeserve's own", "protobuf", "gRPC", "libraries", "kernel"]


def part_of(library, symbol):
    if library.startswith("[kernel"):
        return "kernel"
    if symbol.startswith("[.] grpc"):  # includes templates of gRPC for messages of spikeserve
        return "gRPC"
    if "protobuf" in library or "google::protobuf" in symbol or "spikeserve::v1::" in symbol:
        return "protobuf"
    if any(name in symbol for name in ENGINE):
        return "engine"
    if "prometheus" in library or "spikeserve::" in symbol:
        return "spikeserve's own"
    # The programs link gRPC statically.
    return "gRPC" if library in ("spikeserve", "echo_server") else "libraries"


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


def measure(spikeload, server, flags):
    """Returns the microseconds of processor time of a decision by part, and their sum."""
    with tempfile.NamedTemporaryFile() as recording:
        command = ["perf", "record", "-q", "-e", "cpu-clock", "-F", str(SAMPLES_PER_SECOND), "-p", str(server.pid)]
        perf = subprocess.Popen([*command, "-o", recording.name], stderr=subprocess.DEVNULL)
        try:
            load = programs.measure_load(spikeload, server, **flags)
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
    flags = bench.load_flags(arguments.mode, arguments.sessions)
    flags.update(rate=arguments.rate, duration=f"{arguments.seconds}s")
    names = ("echo", "deciding_echo", "spikeserve")
    rounds = {name: [] for name in names}
    with bench.running_servers(arguments) as servers:
        for _ in range(arguments.rounds):
            for name in names:
                rounds[name].append(measure(arguments.bin / "spikeload", servers[name], flags))
    columns = [bench.summarize(rounds[name]) for name in names]
    print("| µs a call | echo | echo with the engine in it | spikeserve |\n| --- | ---: | ---: | ---: |")
    for part in [*PARTS, "together"]:
        print(f"| {part} | " + " | ".join(f"{column[part]:.1f}" for column in columns) + " |")


if __name__ == "__main__":
    main()
