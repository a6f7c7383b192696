"""Faults that the chaos suite makes, one after the other, while sessions play."""

import asyncio
import contextlib
import dataclasses
import itertools
import time

from tests.chaos.network import CLIENTS, STORE

FAULTS = (
    "kill",
    "stop",
    "cut from the store",
    "cut from the clients",
    "kill Redis",
    "rolling restart",
)


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

    def __init__(self, redis, replicas, hosts, kinds, period, pause, random):
        self._redis = redis
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
            meets_all = kind in ("kill Redis", "rolling restart")
            victims = self._replicas if meets_all else [self._replicas[victim]]
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
        else:
            link = STORE if kind == "cut from the store" else CLIENTS
            host.cut(link)
            await asyncio.sleep(self._pause)
            host.heal(link)
