"""Plays sessions on three replicas and one Redis, or a Cluster, while they are killed, stopped and cut off.

usage: python -m tests.chaos [--sessions=N] [--learners=N] [--decisions=N] [--rate=N] [--timeout=SECONDS]
  [--kinds=KIND,...] [--group=N] [--faults=KIND,...] [--period=SECONDS] [--pause=SECONDS] [--seed=N] [--rounds=N]
  [--cluster]

Compares every answer, and the learned heads, bit for bit with a run on one server that nothing disturbs. Other sessions
learn the head of the fleet meanwhile: it must be the same on all replicas in the end, with each contribution once. Needs
root, for network namespaces, and the variable SPIKESERVE_PROGRAM. Exits with status 1 if an answer or a head differs, an
error reaches a session or a kind of fault was not made, and with 77 if it may not make namespaces.
"""

import argparse
import asyncio
import bisect
import contextlib
import os
import pathlib
import random
import subprocess
import sys
import time

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python")]

from replicated import REPLICAS  # noqa: E402
from restartable_server import RestartableServer  # noqa: E402
from serving import running_server  # noqa: E402

from tests.chaos.faults import CLUSTER_FAULTS, EVICTING, FAULTS, MAY_LOSE_ENTRIES, Chaos  # noqa: E402
from tests.chaos.fleet_learners import FleetLearners, heads_of  # noqa: E402
from tests.chaos.network import Host, enter_own_namespace  # noqa: E402
from tests.chaos.stores import running_store  # noqa: E402
from tests.chaos.workload import GROUP, KINDS, Workload  # noqa: E402

SKIPPED = 77


def parse_arguments():
    parser = argparse.ArgumentParser(prog="tests.chaos")
    parser.add_argument("--sessions", type=int, default=512)
    parser.add_argument("--learners", type=int, default=16, help="sessions that learn the head of the fleet")
    parser.add_argument("--decisions", type=int, default=2000, help="of each session")
    parser.add_argument("--rate", type=float, default=20.0, help="decisions a second of a session, at most")
    parser.add_argument("--faults", help=f"kinds, separated by commas; all but {' and '.join(EVICTING)} by default")
    parser.add_argument("--cluster", action="store_true", help="Redis is a Cluster, whose slots move")
    parser.add_argument("--timeout", type=float, default=1.0, help="seconds until clients give a silent server up")
    parser.add_argument("--kinds", help="how sessions play, separated by commas")
    parser.add_argument("--group", type=int, default=GROUP, help="sessions of a batch or a stream")
    parser.add_argument("--period", type=float, default=5.0, help="seconds between faults")
    parser.add_argument("--pause", type=float, default=30.0, help="seconds that a replica is away")
    parser.add_argument("--seed", type=int, default=1, help="of the faults of the first round")
    parser.add_argument("--rounds", type=int, default=1, help="disturbed runs, each with the next seed")
    arguments = parser.parse_args()
    faults = CLUSTER_FAULTS if arguments.cluster else FAULTS
    arguments.faults = arguments.faults or ",".join(faults)
    arguments.kinds = arguments.kinds or ",".join(KINDS)
    for name, known in (("faults", faults if arguments.cluster else (*faults, *EVICTING)), ("kinds", KINDS)):
        chosen = getattr(arguments, name).split(",")
        if unknown := set(chosen) - set(known):
            parser.error(f"--{name}: expected some of {', '.join(known)}, received {', '.join(unknown)}")
        setattr(arguments, name, chosen)
    return arguments


@contextlib.contextmanager
def running_replicas(cluster):
    """Starts Redis and the replicas, each in a namespace of its own, and yields all of them."""
    with running_store(cluster) as store, contextlib.ExitStack() as stack:
        replicas, hosts = [], []
        for number in range(1, REPLICAS + 1):
            host = Host(number)
            stack.callback(host.close)
            replica = RestartableServer(
                f"--session_store={store.url}",
                "--insecure_network",
                "--session_ttl=24h",
                host=host.address,
                prefix=host.prefix,
            )
            stack.callback(replica.kill)
            replica.start()
            hosts.append(host)
            replicas.append(replica)
        yield store, replicas, hosts


async def play_disturbed(workload, learners, chaos, replicas):
    """Plays until all sessions have ended, with faults all the time. Returns the shared head of each replica."""
    servers = ",".join(replica.address for replica in replicas)
    others = [asyncio.create_task(chaos.run()), asyncio.create_task(learners.play(servers))]
    playing = asyncio.create_task(workload.play(servers))
    await asyncio.wait([playing, *others], return_when=asyncio.FIRST_COMPLETED)
    for other in others:
        if other.done():
            other.result()  # raises what went wrong
    await playing
    chaos.stop()
    learners.stop()
    await asyncio.gather(*others)
    return await heads_of(replicas)


def pauses_of(fault, period, answers):
    """Returns the longest wait of each session that was at a replica which the fault met, until the next fault."""
    pauses = []
    for of_session in answers.values():
        first = bisect.bisect_left(of_session, fault.begin, key=lambda answer: answer.at)
        if first == 0 or of_session[first - 1].server not in fault.victims:
            continue
        last = bisect.bisect_right(of_session, fault.end + period, key=lambda answer: answer.at)
        pauses += [max(answer.seconds for answer in of_session[first:last])] if first < last else []
    return pauses


def report(workload, learners, entries, chaos, period, seconds):
    """Prints what was made and how long sessions waited for their answers then."""
    print(f"{workload.decided} decisions in {seconds:.0f} s, {len(chaos.made)} faults")
    print(f"{learners.episodes} episodes were learned by the fleet, {entries} contributions are in its log")
    if learners.diverged:
        print(f"{learners.diverged} answers of its sessions depend on what Redis has lost, which their clients say")
    print(f"{'fault':22} {'times':>5} {'pauses':>7} {'p50':>9} {'p99':>9} {'max':>9}")
    for kind in dict.fromkeys((*FAULTS, *CLUSTER_FAULTS, *EVICTING)):
        made = [fault for fault in chaos.made if fault.kind == kind]
        pauses = sorted(
            pause for fault in made for pause in pauses_of(fault, period, workload.answers)
        )
        if pauses:
            p50, p99 = (1000 * pauses[int(len(pauses) * part)] for part in (0.5, 0.99))
            print(
                f"{kind:22} {len(made):5} {len(pauses):7}"
                f" {p50:6.0f} ms {p99:6.0f} ms {1000 * pauses[-1]:6.0f} ms"
            )


def head_errors(heads, entries, episodes, may_lose):
    """Returns what is wrong with the shared heads. `may_lose`: Redis has lost what it had acknowledged."""
    errors = [
        f"head: replica {i} has another one than replica 0"
        for i, head in enumerate(heads)
        if head != heads[0]
    ]
    if entries > episodes or (entries < episodes and not may_lose):
        errors.append(f"head: expected {episodes} contributions in its log, received {entries}")
    return errors


def play_round(arguments, undisturbed, seed):
    """Plays with faults, prints what was made, and returns what is wrong and how many decisions were made."""
    pace = arguments.rate, arguments.timeout
    disturbed = Workload(arguments.sessions, arguments.decisions, True, *pace, expected=undisturbed)
    disturbed.kinds, disturbed.group = arguments.kinds, arguments.group
    learners = FleetLearners(arguments.learners, *pace)
    begin = time.monotonic()
    with running_replicas(arguments.cluster) as (store, replicas, hosts):
        times = arguments.period, arguments.pause
        chaos = Chaos(store, replicas, hosts, arguments.faults, *times, random.Random(seed))
        heads = asyncio.run(play_disturbed(disturbed, learners, chaos, replicas))
        entries = store.entries() if learners.episodes else 0
    print(f"seed {seed}: ", end="")
    report(disturbed, learners, entries, chaos, arguments.period, time.monotonic() - begin)
    different = [i for i, digest in undisturbed.digests.items() if disturbed.digests[i] != digest]
    print(f"{len(different)} of {arguments.sessions} sessions differ from the undisturbed run", flush=True)
    made = {fault.kind for fault in chaos.made}
    errors = head_errors(heads, entries, learners.episodes, bool(made & MAY_LOSE_ENTRIES))
    errors += [f"session {i}: differs" for i in different]
    errors += [f"not made: {kind}" for kind in arguments.faults if kind not in made]
    return [f"seed {seed}: {error}" for error in errors], disturbed.decided


def play_all(arguments):
    """Plays undisturbed, and disturbed in each round. Returns what is wrong."""
    undisturbed = Workload(arguments.sessions, arguments.decisions, stored=False)
    with running_server(flags=["--session_ttl=24h"]) as server:  # a busy machine lets sessions wait
        asyncio.run(undisturbed.play(server.grpc))
    print(f"{undisturbed.decided} decisions without a disturbance", flush=True)
    errors, decided = [], 0
    for seed in range(arguments.seed, arguments.seed + arguments.rounds):
        wrong, made = play_round(arguments, undisturbed, seed)
        print(*wrong, sep="\n", flush=True)
        errors, decided = errors + wrong, decided + made
    print(f"{decided} decisions in {arguments.rounds} rounds, {len(errors)} errors")
    return errors


def main():
    arguments = parse_arguments()
    if subprocess.run(["unshare", "-n", "true"], check=False).returncode != 0:
        print("chaos: skipped, because network namespaces need root")
        return SKIPPED
    enter_own_namespace()
    return 1 if play_all(arguments) else 0


if __name__ == "__main__":
    os.chdir(ROOT)
    sys.exit(main())
