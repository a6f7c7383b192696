"""Faults that the chaos suite makes, one after the other, while sessions play."""

import asyncio
import dataclasses
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
    """A fault that was made, with its times of time.monotonic()."""

    kind: str
    begin: float
    end: float


class Chaos:
    """Makes a fault every `period` seconds: all kinds in turn, at a random replica.

    A stopped or cut-off replica comes back after `pause` seconds.
    """

    def __init__(self, redis, replicas, hosts, period, pause, random):
        self._redis = redis
        self._replicas = replicas
        self._hosts = hosts
        self._period = period
        self._pause = pause
        self._random = random
        self.made = []

    async def run(self):
        """Makes faults until it is cancelled."""
        while True:
            for kind in FAULTS:
                await asyncio.sleep(self._period)
                begin = time.monotonic()
                # A fault that has begun is ended, so that every replica serves in the end.
                await asyncio.shield(self._make(kind))
                self.made.append(Fault(kind, begin, time.monotonic()))

    async def _make(self, kind):
        victim = self._random.randrange(len(self._replicas))
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
