"""Faults that the chaos suite makes, one after the other, while sessions play."""

import asyncio
import contextlib
import dataclasses
import itertools
import time

from redis_servers import DURABLE, Files, Redis
from security import until

from tests.chaos.network import CLIENTS, STORE

FAULTS = (
    "kill",
    "stop",
    "cut from the store",
    "cut from the clients",
    "kill Redis",
    "rolling restart",
    "fill Redis",
    "set Redis back",
    "fail over late",
)
# Not among the others: while Redis may evict, SYNC is refused, so that sessions wait long.
EVICT = "evict"  # some keys, at once
LRU = "volatile-lru"  # for longer than the servers need to notice
EVICTING = (EVICT, LRU)
CLUSTER_FAULTS = (
    "kill",
    "stop",
    "cut from the store",
    "cut from the clients",
    "rolling restart",
    "fill Redis",
    "move slots",
)
LOSES_TAIL = {"set Redis back", "fail over late"}  # Redis forgets what it has acknowledged
MAY_LOSE_ENTRIES = {*EVICTING, *LOSES_TAIL}  # of the log of the shared head, until a replica writes it again
MEETS_ALL = {"kill Redis", "rolling restart", "fill Redis", "move slots", *MAY_LOSE_ENTRIES}


FULL_SECONDS = 5.0
LOST_SECONDS = 1.0
EVICTED_BYTES = 32 << 10  # at once
EVICTIONS = 5
EVICTION_PAUSE = 0.2  # seconds
LRU_SECONDS = 8.0  # servers read the settings every 5


def evict(redis, policy="volatile-random"):
    """Redis removes some keys of those that have an expiry: hashes and journals of sessions, and markers."""

    def number(section, name):
        lines = redis.command(f"INFO {section}").decode().splitlines()
        return int(next(line.partition(":")[2] for line in lines if line.startswith(f"{name}:")))

    def is_evicted():
        nonlocal limit
        limit = max(limit - EVICTED_BYTES, 1)  # some of the memory in use does not count
        redis.command(f"CONFIG SET maxmemory {limit}")
        return limit == 1 or number("stats", "evicted_keys") > before  # at 1, there is nothing to remove

    before = number("stats", "evicted_keys")
    limit = number("memory", "used_memory")
    redis.command(f"CONFIG SET maxmemory-policy {policy}")
    until(is_evicted)


def keep_all(redis):
    """Redis removes no more keys."""
    redis.command("CONFIG SET maxmemory 0")
    redis.command("CONFIG SET maxmemory-policy noeviction")


async def evict_for_long(redis):
    """Redis may remove keys, and does so again and again."""
    end = time.monotonic() + LRU_SECONDS
    while time.monotonic() < end:
        await asyncio.to_thread(evict, redis, LRU)
        await asyncio.sleep(EVICTION_PAUSE)
    keep_all(redis)


async def set_back(redis):
    """Redis is killed and starts again with its append-only file of a second ago. The replicas live."""
    files = await asyncio.to_thread(Files, redis)
    await asyncio.sleep(LOST_SECONDS)
    await asyncio.to_thread(files.restore)


async def fail_over_late(redis):
    """A copy that follows no more since a second takes the place of Redis. The replicas live."""
    copy = await asyncio.to_thread(Redis, *DURABLE, password="", host="0.0.0.0")
    copy.command(f"REPLICAOF 127.0.0.1 {redis.port}")
    await asyncio.to_thread(until, lambda: b"master_link_status:up" in copy.command("INFO replication"))
    copy.command("REPLICAOF NO ONE")
    await asyncio.sleep(LOST_SECONDS)
    redis.kill()
    assert copy.command(f"CONFIG SET port {redis.port}") == b"OK"
    redis.replace_by(copy)


@dataclasses.dataclass
class Fault:
    """A fault that was made, with its times of time.monotonic() and the addresses of the replicas that it met."""

    kind: str
    begin: float
    end: float
    victims: frozenset


class Chaos:
    """Makes the next fault `period` seconds after the last one has ended: all of `kinds` in turn, at a random replica.

    A stopped or cut-off replica comes back after `pause` seconds.
    """

    def __init__(self, store, replicas, hosts, kinds, period, pause, random):
        self._store = store
        self._redis = store.nodes[0]
        self._replicas = replicas
        self._hosts = hosts
        self._kinds = kinds
        self._period = period
        self._pause = pause
        self._random = random
        self._stopping = asyncio.Event()
        self.made = []

    async def run(self):
        """Makes faults until stop(). Every replica serves in the end."""
        for kind in itertools.cycle(self._kinds):
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._stopping.wait(), self._period)
            if self._stopping.is_set():
                return
            victim = self._random.randrange(len(self._replicas))
            begin = time.monotonic()
            await self._make(kind, victim)
            victims = self._replicas if kind in MEETS_ALL else [self._replicas[victim]]
            addresses = frozenset(replica.address for replica in victims)
            self.made.append(Fault(kind, begin, time.monotonic(), addresses))

    def stop(self):
        """Lets run() end after the fault that is being made."""
        self._stopping.set()

    async def _make(self, kind, victim):
        replica, host = self._replicas[victim], self._hosts[victim]
        if kind == "kill":
            replica.kill()
            await asyncio.to_thread(replica.start)
        elif kind == "stop":
            replica.stop()
            await asyncio.sleep(self._pause)
            replica.resume()
        elif kind == "kill Redis":
            self._redis.kill()
            await asyncio.to_thread(self._redis.start)
        elif kind == "rolling restart":
            for other in self._replicas:
                await asyncio.to_thread(other.restart)
        elif kind == "fill Redis":
            self._store.command("CONFIG SET maxmemory 1")  # noeviction: writes are refused
            await asyncio.sleep(min(self._pause, FULL_SECONDS))
            self._store.command("CONFIG SET maxmemory 0")
        elif kind == EVICT:
            for _ in range(EVICTIONS):
                await asyncio.to_thread(evict, self._redis)
                keep_all(self._redis)
                await asyncio.sleep(EVICTION_PAUSE)
        elif kind == LRU:
            await evict_for_long(self._redis)
        elif kind == "move slots":
            await asyncio.to_thread(self._store.move_slots, self._random)
        elif kind == "set Redis back":
            await set_back(self._redis)
        elif kind == "fail over late":
            await fail_over_late(self._redis)
        else:
            link = STORE if kind == "cut from the store" else CLIENTS
            host.cut(link)
            await asyncio.sleep(self._pause)
            host.heal(link)
