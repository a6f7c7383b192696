#!/usr/bin/env python3
"""Measures how a flood of requests from one tenant changes the latency of another tenant.

Starts a server with two tenants. One of them, the flood, has a limit. Measures the latency of the other tenant, the
neighbour, alone and beside each kind of flood, in turn. Prints the medians over all rounds as JSON, with the number of
cores that the server used. The kinds of flood:

    within       400 decisions a second on streams, which the default limit allows
    polite       agents far above their limit on streams, which wait 10 ms after a rejection
    rude         the same without waiting
    rude_unary   the same without waiting, with one call for each request
    oversized    requests of 5 MB, which gRPC rejects
    wrong_token  calls with a token that the server does not know
    datagrams    datagrams that are replayed, forged, cut off, or name a key that does not exist, in turn

The last three kinds need grpcio.

    build/venv/bin/python lab/bench/flood_bench.py --bin=build/release/bin --policies=deploy/policies
"""

import argparse
import contextlib
import hashlib
import itertools
import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import types

import programs

FIGURES = ("decisions_per_second", "p50_seconds", "p99_seconds", "server_cores")
SPIKELOAD = {
    "within": ["--mode=stream", "--rate=400"],
    "polite": ["--mode=stream"],
    "rude": ["--mode=stream", "--pause_after_error=0s"],
    "rude_unary": ["--mode=unary", "--pause_after_error=0s"],
}
HAMMER = {"oversized": ("neighbour", 5_000_000), "wrong_token": ("wrong", 100), "datagrams": ("flood", 0)}
CALLS_UNDER_WAY = {"oversized": 4, "wrong_token": 64}


def entry(token, tenant):
    digest = hashlib.sha256(token.encode()).hexdigest()
    return {"sha256": digest, "tenant": tenant, "role": "agent"}


@contextlib.contextmanager
def running_server(arguments):
    with tempfile.TemporaryDirectory() as folder:
        tokens = pathlib.Path(folder) / "tokens.json"
        tenants = {"neighbour": {}, "flood": {"decisions_per_second": arguments.limit}}
        entries = [entry(tenant, tenant) for tenant in tenants]
        tokens.write_text(json.dumps({"tenants": tenants, "tokens": entries}))
        command = [
            arguments.server or arguments.bin / "spikeserve",
            f"--policies={arguments.policies}",
            f"--tokens={tokens}",
            "--listen=127.0.0.1:0",
            "--http_listen=",
            "--datagram_listen=127.0.0.1:0",
            "--reflection_v1alpha",  # for the kind datagrams
        ]
        with programs.running_server(command, programs.SPIKESERVE, programs.ALL_CORES) as server:
            yield server


def start(command, token):
    environment = {**os.environ, "SPIKESERVE_TOKEN": token}
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )


def spikeload(arguments, address, token, sessions, seconds, flags):
    return start(
        [
            str(arguments.bin / "spikeload"),
            f"--server={address}",
            "--policy=cartpole",
            f"--sessions={sessions}",
            f"--duration={seconds}s",
            "--json",
            *flags,
        ],
        token,
    )


def flood(arguments, address, kind):
    """Starts a process that floods the server for longer than a measurement takes."""
    seconds = arguments.head_start + arguments.seconds + 1
    if kind in SPIKELOAD:
        flags = SPIKELOAD[kind]
        return spikeload(arguments, address, "flood", arguments.flood, seconds, flags)
    command = [sys.executable, __file__, f"--hammer={kind}", f"--address={address}"]
    return start([*command, f"--seconds={seconds}"], HAMMER[kind][0])


def hammer(arguments):
    """Makes concurrent calls that the server rejects. Prints their number by status code as JSON."""
    import grpc

    if arguments.hammer == "datagrams":
        return print(json.dumps({"errors": throw_datagrams(arguments)}))
    token, size = HAMMER[arguments.hammer]
    metadata = (("authorization", f"Bearer {token}"),)
    # The wire format of an ActRequest whose field 1, session_id, has a length of four bytes.
    length = bytes([(size & 127) | 128, (size >> 7 & 127) | 128, (size >> 14 & 127) | 128, size >> 21])
    request = b"\x0a" + length + b"x" * size
    codes = {}
    over = threading.Event()
    lock = threading.Lock()

    def keep_calling():
        with grpc.insecure_channel(arguments.address) as channel:
            act = channel.unary_unary("/spikeserve.v1.PolicyService/Act")
            while not over.is_set():
                try:
                    act(request, metadata=metadata)
                except grpc.RpcError as error:
                    with lock:
                        codes[error.code().name] = codes.get(error.code().name, 0) + 1

    callers = [threading.Thread(target=keep_calling) for _ in range(CALLS_UNDER_WAY[arguments.hammer])]
    for caller in callers:
        caller.start()
    over.wait(arguments.seconds)
    over.set()
    for caller in callers:
        caller.join()
    print(json.dumps({"decisions": 0, "errors": sum(codes.values()), "codes": codes}))


def throw_datagrams(arguments):
    """Sends datagrams that the server drops. Returns their number."""
    import grpc

    sys.path.append(str(pathlib.Path(__file__).parents[2] / "tests/python"))
    from sealed_datagrams import Robot
    from security import service_with

    addresses = types.SimpleNamespace(grpc=arguments.address)
    with service_with(addresses, "flood") as agent, grpc.insecure_channel(arguments.address) as channel:
        opened = agent.OpenSession(policy="cartpole", datagrams=True)
        robot = Robot(types.SimpleNamespace(channel=channel), opened)
        taken = robot.sealed(0, observation=[0.0] * 4)
        robot.send(taken)
        ends = time.monotonic() + arguments.seconds
        for sent in itertools.count(step=4):
            if time.monotonic() > ends:
                return sent
            forged = taken[:9] + (sent + 1).to_bytes(8, "big") + taken[17:]
            for datagram in (taken, forged, taken[:20], taken[:1] + os.urandom(8) + taken[9:]):
                robot.send(datagram)


def measure(arguments, server, kind):
    """Returns the report of the neighbour, and that of the flood; None for the kind `alone`."""
    flooding = None if kind == "alone" else flood(arguments, server.address, kind)
    time.sleep(arguments.head_start if flooding else 0)
    before = server.processor_seconds()
    neighbour = spikeload(
        arguments, server.address, "neighbour", 16, arguments.seconds, ["--mode=stream", *arguments.load]
    )
    report = json.loads(neighbour.communicate()[0])
    report["server_cores"] = (server.processor_seconds() - before) / arguments.seconds
    return report, json.loads(flooding.communicate()[0]) if flooding else None


def quiet_p99(rounds):
    """Returns the lower quartile, because other load on the machine only increases a latency."""
    return sorted(r["p99_seconds"] for r in rounds)[len(rounds) // 4]


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--bin", type=pathlib.Path, default=pathlib.Path("build/release/bin"))
    parser.add_argument("--server", type=pathlib.Path, help="path of spikeserve, if it is not in --bin")
    parser.add_argument("--policies", default="deploy/policies")
    parser.add_argument("--seconds", type=float, default=3, help="seconds of each measurement")
    parser.add_argument(
        "--head_start",
        type=float,
        default=1,
        help="seconds of flood before a measurement, so that it uses up the burst that its limit allows",
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--flood", type=int, default=64, help="sessions of the tenant that floods")
    parser.add_argument("--limit", type=float, default=500, help="limit of that tenant, decisions a second")
    parser.add_argument("--rate", type=float, help="decisions a second of the neighbour (default: as many as possible)")
    parser.add_argument("--kinds", nargs="*", default=[*SPIKELOAD, *HAMMER])
    parser.add_argument("--hammer", choices=HAMMER, help=argparse.SUPPRESS)
    parser.add_argument("--address", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.hammer:
        return hammer(arguments)
    arguments.load = [f"--rate={arguments.rate}"] if arguments.rate else []

    reports = {kind: [] for kind in ("alone", *arguments.kinds)}
    floods = {kind: [] for kind in arguments.kinds}
    with running_server(arguments) as server:
        for _ in range(arguments.rounds):
            for kind in reports:
                report, flooded = measure(arguments, server, kind)
                reports[kind].append(report)
                if flooded:
                    floods[kind].append(flooded)
    result = {}
    for kind, rounds in reports.items():
        result[kind] = {figure: statistics.median(r[figure] for r in rounds) for figure in FIGURES}
        result[kind]["quiet_p99_seconds"] = quiet_p99(rounds)
        if kind != "alone":
            ratios = [
                beside["p99_seconds"] / alone["p99_seconds"]
                for beside, alone in zip(rounds, reports["alone"], strict=True)
            ]
            result[kind]["p99_ratio"] = statistics.median(ratios)
            result[kind]["quiet_p99_ratio"] = quiet_p99(rounds) / quiet_p99(reports["alone"])
            flooded = arguments.head_start + arguments.seconds + 1
            refused = [f["errors"] / flooded for f in floods[kind]]
            result[kind]["refused_per_second"] = statistics.median(refused)
            result[kind]["refused"] = sum(f["errors"] for f in floods[kind])
    print(json.dumps(result, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
