"""Plays sessions on three replicas and one Redis while they are killed, stopped and cut off.

usage: python -m tests.chaos [--sessions=N] [--decisions=N] [--rate=N] [--period=SECONDS] [--pause=SECONDS] [--seed=N]

Compares every answer, and the learned heads, bit for bit with a run on one server that nothing disturbs. Needs root, for
network namespaces, and the variable SPIKESERVE_PROGRAM. Exits with status 1 if an answer differs, an error reaches a
session or a kind of fault was not made, and with 77 if it may not make namespaces.
"""

import argparse
import asyncio
import contextlib
import os
import pathlib
import random
import subprocess
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python")]

from replicated import REPLICAS, Redis  # noqa: E402
from restartable_server import RestartableServer  # noqa: E402
from serving import running_server  # noqa: E402

from tests.chaos.faults import FAULTS, Chaos  # noqa: E402
from tests.chaos.network import Host, enter_own_namespace  # noqa: E402
from tests.chaos.workload import Workload  # noqa: E402

SKIPPED = 77


def parse_arguments():
    parser = argparse.ArgumentParser(prog="tests.chaos")
    parser.add_argument("--sessions", type=int, default=512)
    parser.add_argument("--decisions", type=int, default=2000, help="of each session")
    parser.add_argument("--rate", type=float, default=20.0, help="decisions a second, at most")
    parser.add_argument("--period", type=float, default=5.0, help="seconds between faults")
    parser.add_argument("--pause", type=float, default=30.0, help="seconds that a replica is away")
    parser.add_argument("--seed", type=int, default=1)
    return parser.parse_args()


@contextlib.contextmanager
def running_replicas():
    """Starts Redis and the replicas, each in a namespace of its own, and yields all of them."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        redis = Redis(pathlib.Path(folder), host="0.0.0.0")
        stack.callback(redis.kill)
        redis.start()
        replicas, hosts = [], []
        for number in range(1, REPLICAS + 1):
            host = Host(number)
            stack.callback(host.close)
            replica = RestartableServer(
                f"--session_store=redis://{host.store_address}:{redis.port}",
                "--insecure_network",
                host=host.address,
                prefix=host.prefix,
            )
            stack.callback(replica.kill)
            replica.start()
            hosts.append(host)
            replicas.append(replica)
        yield redis, replicas, hosts


async def play_disturbed(workload, chaos, servers):
    """Plays until all sessions have ended, with faults all the time."""
    faults = asyncio.create_task(chaos.run())
    playing = asyncio.create_task(workload.play(servers))
    await asyncio.wait([faults, playing], return_when=asyncio.FIRST_COMPLETED)
    faults.cancel()
    if faults.done() and not faults.cancelled():
        faults.result()  # raises what went wrong
    await playing


def report(workload, chaos, seconds):
    """Prints what was made and how long sessions waited for their answers then."""
    print(f"{workload.decided} decisions in {seconds:.0f} s, {len(chaos.made)} faults")
    print(f"{'fault':22} {'times':>5} {'pause p50':>10} {'pause p99':>10}")
    for kind in FAULTS:
        made = [fault for fault in chaos.made if fault.kind == kind]
        pauses = sorted(
            answer.seconds
            for answer in workload.answers
            if any(fault.begin <= answer.at <= fault.end + 1 for fault in made)
        )
        if pauses:
            p50, p99 = (1000 * pauses[int(len(pauses) * part)] for part in (0.5, 0.99))
            print(f"{kind:22} {len(made):5} {p50:7.0f} ms {p99:7.0f} ms")


def main():
    arguments = parse_arguments()
    if subprocess.run(["unshare", "-n", "true"], check=False).returncode != 0:
        print("chaos: skipped, because network namespaces need root")
        return SKIPPED
    enter_own_namespace()
    size = arguments.sessions, arguments.decisions
    undisturbed = Workload(*size, stored=False)
    with running_server() as server:
        asyncio.run(undisturbed.play(server.grpc))
    disturbed = Workload(*size, stored=True, rate=arguments.rate)
    begin = time.monotonic()
    with running_replicas() as (redis, replicas, hosts):
        chaos = Chaos(
            redis, replicas, hosts, arguments.period, arguments.pause, random.Random(arguments.seed)
        )
        servers = ",".join(replica.address for replica in replicas)
        asyncio.run(play_disturbed(disturbed, chaos, servers))
    report(disturbed, chaos, time.monotonic() - begin)
    different = [i for i, digest in undisturbed.digests.items() if disturbed.digests[i] != digest]
    print(f"{len(different)} of {arguments.sessions} sessions differ from the undisturbed run")
    if different:
        print("sessions:", *different)
    missing = sorted(set(FAULTS) - {fault.kind for fault in chaos.made})
    if missing:
        print("not made:", *missing)
    return 1 if different or missing else 0


if __name__ == "__main__":
    os.chdir(ROOT)
    sys.exit(main())
