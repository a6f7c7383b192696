"""Sessions of the chaos suite that learn the head of the fleet."""

import asyncio
import contextlib

import spikeserve
from replicated import observation, reward

from tests.chaos.workload import client_options, opened

STEPS = 10  # decisions of an episode
POLICY = {"policy": "cartpole", "version": 1}
SESSION_OPTIONS = spikeserve.SessionOptions(
    version=POLICY["version"],
    sample=True,
    temperature=4.0,
    learning=spikeserve.Learning(scope="FLEET", learning_rate=0.3),
)


class FleetLearners:
    """Plays `count` sessions until stop(). What they decide depends on the order of all contributions, so only the heads are
    compared: those of all replicas, and with the number of `episodes` that have ended. If Redis loses its last second, what a
    session decides again may depend on another head than before: the client says so, and `diverged` counts it.
    """

    def __init__(self, count, rate, timeout):
        self._count = count
        self._interval = 1 / rate
        self._options = client_options(timeout)
        self._stopping = asyncio.Event()
        self.episodes = 0
        self.diverged = 0

    def stop(self):
        """Lets play() return when all episodes have ended."""
        self._stopping.set()

    async def play(self, servers):
        """Plays until stop()."""
        async with spikeserve.AsyncClient(servers, self._options) as client:
            await asyncio.gather(*(self._learn(client, i) for i in range(self._count)))

    async def _learn(self, client, i):
        async with await opened(client, POLICY["policy"], SESSION_OPTIONS) as session:
            while not self._stopping.is_set():
                for t in range(STEPS):
                    with self._divergence():
                        await session.act(observation(0, t + i), reward(t))
                    await asyncio.sleep(self._interval)
                with self._divergence():
                    await session.end_episode(1.0, terminated=True)
                self.episodes += 1

    @contextlib.contextmanager
    def _divergence(self):
        try:
            yield
        except spikeserve.DivergedError:
            self.diverged += 1


async def heads_of(replicas):
    """Returns the shared head of each replica, with all that replicas must agree on."""
    heads = []
    for replica in replicas:
        async with spikeserve.AsyncAdminClient(replica.address) as admin:
            head = await admin.get_head(**POLICY, include_weights=True)
        heads.append((head.delta[:], head.updates, head.rejected_updates, head.rollbacks))
    return heads
