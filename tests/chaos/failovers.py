"""Plays sessions on two replicas while the primary of Redis is killed, again and again.

usage: python -m tests.chaos.failovers [--failovers=N] [--sessions=N] [--decisions=N]

Redis is a primary, a replica and three Sentinels; the servers run with --store_replicas=1. A primary that was killed comes
back empty, as the replica of the new one. Compares every answer bit for bit with a run that nothing disturbs. Needs the
variable SPIKESERVE_PROGRAM. Exits with status 1 if an answer differs or an error reaches a session.
"""

import argparse
import asyncio
import contextlib
import os
import pathlib
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python")]

from redis_servers import PASSWORD, Redis, Sentinel, is_watched, primary_port, stopping
from restartable_server import RestartableServer
from security import until
from serving import running_server

from tests.chaos.workload import Workload

RATE = 10.0  # decisions a second of a session, at most
SECONDS = 5.0  # until clients give up a server that says nothing
SERVERS = 2
SILENCE = 3000  # milliseconds; a primary that waits for a busy processor is not given up


class WatchedRedis:
    """Two Redis servers, of which one is the primary, and three Sentinels."""

    def __init__(self, folder, servers):
        self._primary = Redis()
        servers.append(self._primary)
        self._replica = Redis("--replicaof", "127.0.0.1", str(self._primary.port))
        servers.append(self._replica)
        self._program = {each: each.program[:] for each in servers}
        self._wait_for_replica()
        self._sentinels = [Sentinel(folder, self._primary, quorum=2, silence=SILENCE) for _ in range(3)]
        servers += self._sentinels
        for sentinel in self._sentinels:
            until(lambda sentinel=sentinel: is_watched(sentinel, replicas=1, sentinels=2))

    @property
    def store(self):
        """Returns --session_store."""
        addresses = ",".join(f"127.0.0.1:{each.port}" for each in self._sentinels)
        return f"redis+sentinel://{addresses}/mymaster"

    def fail_over(self):
        """Kills the primary, waits for the new one, and starts the old one as its replica."""
        old, new = self._primary, self._replica
        chosen = {primary_port(each) for each in self._sentinels}
        assert chosen == {old.port}, f"expected no failover by itself of {old.port}, received {chosen}"
        old.kill()
        until(lambda: all(primary_port(each) == new.port for each in self._sentinels))
        until(lambda: b"role:master" in (new.command("INFO replication") or b""))
        self._primary, self._replica = new, old
        old.program = [*self._program[old], "--replicaof", "127.0.0.1", str(new.port)]
        old.start()
        self._wait_for_replica()
        # A Sentinel promotes only a replica that it has seen.
        for sentinel in self._sentinels:
            until(lambda sentinel=sentinel: self._is_promotable(sentinel))

    def _wait_for_replica(self):
        until(lambda: b"state=online" in (self._primary.command("INFO replication") or b""))

    def _is_promotable(self, sentinel):
        replicas = sentinel.command("SENTINEL REPLICAS mymaster")
        [fields] = replicas if isinstance(replicas, list) and replicas else [[]]
        state = dict(zip(fields[::2], fields[1::2], strict=True))
        return (state.get(b"flags"), state.get(b"master-link-status")) == (b"slave", b"ok")


async def answered_by_all(workload, sessions, playing):
    """Waits until every session has had another answer, or all have ended."""
    before = [len(workload.answers[i]) for i in range(sessions)]
    while not playing.done() and any(len(workload.answers[i]) <= before[i] for i in range(sessions)):
        await asyncio.sleep(0.05)
    if playing.done():
        playing.result()  # raises what went wrong


async def fail_over_while_playing(workload, servers, redis, failovers, sessions, decisions):
    """Plays until all sessions have ended. All of them play before, during and after each failover.

    Returns the seconds that each failover took.
    """
    part = decisions // (failovers + 1)
    workload.steps_allowed = 2 * part
    playing = asyncio.create_task(workload.play(servers))
    seconds = []
    for _ in range(failovers):
        await answered_by_all(workload, sessions, playing)
        begin = time.monotonic()
        await asyncio.to_thread(redis.fail_over)
        seconds.append(time.monotonic() - begin)
        workload.steps_allowed += part
    workload.steps_allowed = decisions
    await playing
    return seconds


def main():
    parser = argparse.ArgumentParser(prog="tests.chaos.failovers")
    parser.add_argument("--failovers", type=int, default=20)
    parser.add_argument("--sessions", type=int, default=96)
    parser.add_argument("--decisions", type=int, default=840, help="of each session")
    arguments = parser.parse_args()
    size = arguments.sessions, arguments.decisions
    undisturbed = Workload(*size, stored=False)
    with running_server() as server:
        asyncio.run(undisturbed.play(server.grpc))
    disturbed = Workload(*size, True, RATE, SECONDS, expected=undisturbed)
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        redis = WatchedRedis(pathlib.Path(folder), stack.enter_context(stopping([])))
        password = pathlib.Path(folder) / "password"
        password.write_text(PASSWORD)
        flags = [f"--store_password_file={password}", "--store_replicas=1"]
        replicas = [RestartableServer(f"--session_store={redis.store}", *flags) for _ in range(SERVERS)]
        for replica in replicas:
            stack.callback(replica.kill)
            replica.start()
        servers = ",".join(replica.address for replica in replicas)
        seconds = asyncio.run(
            fail_over_while_playing(disturbed, servers, redis, arguments.failovers, *size)
        )
    waits = sorted(answer.seconds for answers in disturbed.answers.values() for answer in answers)
    print(f"{disturbed.decided} decisions, {len(seconds)} failovers of {min(seconds):.1f} to {max(seconds):.1f} s")
    print(f"answers: p99 {1000 * waits[int(len(waits) * 0.99)]:.0f} ms, max {1000 * waits[-1]:.0f} ms")
    different = [i for i, digest in undisturbed.digests.items() if disturbed.digests[i] != digest]
    print(f"{len(different)} of {arguments.sessions} sessions differ from the undisturbed run", *different)
    return 1 if different else 0


if __name__ == "__main__":
    os.chdir(ROOT)
    sys.exit(main())
