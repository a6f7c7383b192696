"""Turns of those who are not known yet: whoever only connects takes little of the gateway."""

from __future__ import annotations

import asyncio
import collections
import contextlib
from collections.abc import AsyncIterator

from spikeserve.gateway.places import Places

_AT_A_TIME = 8  # in all
_OF_ADDRESS = 2
_WAITING = 512  # in all; one address has at most as many as are left
_REFUSAL_SECONDS = 1.0


class Turns:
    """Two of an address have their turn at a time. Belongs to one event loop."""

    def __init__(self) -> None:
        self._all = asyncio.Semaphore(_AT_A_TIME)
        self._by_address: dict[str, asyncio.Semaphore] = {}
        self._users: collections.Counter[str] = collections.Counter()
        self._waiting = Places(_WAITING)

    @contextlib.asynccontextmanager
    async def turn(self, address: str) -> AsyncIterator[bool]:
        """Waits for a turn and holds it. Yields False, later, if too many of the address wait."""
        with self._waiting.taken(address) as may_wait:
            if not may_wait:
                await asyncio.sleep(_REFUSAL_SECONDS)
                yield False
                return
            of_address = self._by_address.setdefault(address, asyncio.Semaphore(_OF_ADDRESS))
            self._users[address] += 1
            try:
                async with of_address, self._all:
                    yield True
            finally:
                self._users[address] -= 1
                if not self._users[address]:
                    del self._users[address], self._by_address[address]
