"""The sessions of the chaos suite, which play by calls, in batches and on streams at the same time."""

import asyncio
import collections
import contextlib
import hashlib
import time
import typing

import spikeserve
from replicated import comparable, comparable_state, observation, options_of, policy_of, reward

from tests.chaos.raw_clients import RawSession, RawStubs

GROUP = 32  # sessions of a batch, or of a stream
GROUPS_OF_A_CLIENT = 64  # a server allows 100 streams a connection, and a client has one to each server
RAW_KINDS = ("raw stubs", "hedged stubs")
KINDS = ("calls", "batches", "streams", *RAW_KINDS)
EPISODE = 50  # decisions
LEVELS = ("ASYNC", "SYNC")

UNDISTURBED_SECONDS = 60.0  # after which a client gives up a server that nothing disturbs


def client_options(timeout):
    """Returns the options of a client that gives up a server after `timeout` seconds of silence."""
    patience = 120 * timeout
    return spikeserve.ClientOptions(
        timeout=timeout,
        connect_timeout=patience,
        retry=spikeserve.RetryOptions(max_elapsed=patience),
    )


class Answered(typing.NamedTuple):
    """When a session had an answer, by time.monotonic(), how long it took in seconds, and from which replica."""

    at: float
    seconds: float
    server: str


class Workload:
    """Plays `sessions` sessions for `decisions` decisions each. `digests` shows what they answered.

    A session makes at most `rate` decisions a second, so that there is time for faults. Clients give a server up after
    `timeout` seconds. With `expected`, a Workload that
    has been played, the first difference of each session is printed at the end of its episode.
    """

    def __init__(
        self, sessions, decisions, stored, rate=None, timeout=UNDISTURBED_SECONDS, expected=None
    ):
        self.kinds = KINDS  # of which each group of sessions plays by one
        self.group = GROUP
        self._sessions = sessions
        self._decisions = decisions
        self._stored = stored
        self._interval = 1 / rate if rate else 0.0
        self._options_of_client = client_options(timeout)
        self._expected = expected
        self._differing = set()
        self._episodes = collections.defaultdict(list)  # by session: the digest after each episode
        self.steps_allowed = decisions  # of each session; a test that raises it keeps all sessions busy
        self.digests = {}
        self.answers = collections.defaultdict(list)  # by session; kept if the sessions are stored
        self.decided = 0

    async def play(self, servers):
        """Plays until all sessions have ended."""
        groups = [
            range(first, min(first + self.group, self._sessions))
            for first in range(0, self._sessions, self.group)
        ]
        play = {
            "calls": self._play_calls,
            "batches": self._play_batches,
            "streams": self._play_stream,
            "raw stubs": lambda client, group: self._play_raw(client, group, servers, hedges=False),
            "hedged stubs": lambda client, group: self._play_raw(client, group, servers, hedges=True),
        }
        players = [play[kind] for kind in self.kinds]
        async with contextlib.AsyncExitStack() as stack:
            clients = [
                await stack.enter_async_context(spikeserve.AsyncClient(servers, self._options_of_client))
                for _ in range(0, len(groups), GROUPS_OF_A_CLIENT)
            ]
            await asyncio.gather(
                *(
                    players[n % len(players)](clients[n // GROUPS_OF_A_CLIENT], group)
                    for n, group in enumerate(groups)
                )
            )

    async def _steps(self, first):
        # Sessions that begin together would wait for each other at every step.
        due = time.monotonic() + self._interval * first / self._sessions
        await asyncio.sleep(due - time.monotonic())
        for t in range(self._decisions):
            while t >= self.steps_allowed:
                await asyncio.sleep(0.05)
            yield t
            due = max(due + self._interval, time.monotonic() - self._interval)
            await asyncio.sleep(due - time.monotonic())

    def _options(self, i):
        # Four kinds of sessions in a row, two policies: the level changes every eight.
        level = LEVELS[i // 8 % 2] if self._stored else "NONE"
        return options_of(i, level)

    async def _open(self, client, group):
        return {i: await client.open_session(policy_of(i), self._options(i)) for i in group}

    async def _play_calls(self, client, group):
        await asyncio.gather(*(self._play_one(client, i) for i in group))

    async def _play_one(self, client, i):
        session = (await self._open(client, [i]))[i]
        digest = hashlib.sha256()
        async for t in self._steps(i):
            begin = time.monotonic()
            decision = await session.act(observation(i, t), reward(t))
            self._take(i, digest, decision, begin, session.cursor.route)
            await self._end_if_due(session, i, t, digest)
        await self._finish(session, i, digest)

    async def _play_batches(self, client, group):
        sessions = await self._open(client, group)
        digests = {i: hashlib.sha256() for i in group}
        async for t in self._steps(group[0]):
            observations = [observation(i, t) for i in group]
            begin = time.monotonic()
            results = await client.act_batch(
                list(sessions.values()), observations, [reward(t)] * len(group)
            )
            for i, decision in zip(group, results, strict=True):
                self._take(i, digests[i], decision, begin, sessions[i].cursor.route)
            for i in group:
                await self._end_if_due(sessions[i], i, t, digests[i])
        for i in group:
            await self._finish(sessions[i], i, digests[i])

    async def _play_stream(self, client, group):
        digests = {i: hashlib.sha256() for i in group}
        async with client.act_stream() as stream:
            opening = (
                client.open_session(policy_of(i), self._options(i), route=stream.route)
                for i in group
            )
            sessions = dict(zip(group, await asyncio.gather(*opening), strict=True))
            of_session = {session: i for i, session in sessions.items()}
            async for t in self._steps(group[0]):
                begin = time.monotonic()
                for i in group:
                    await stream.send(sessions[i], observation(i, t), reward(t))
                for _ in group:
                    session, answer = await stream.receive()
                    i = of_session[session]
                    self._take(i, digests[i], answer, begin, stream.route)
                for i in group:
                    await self._end_if_due(sessions[i], i, t, digests[i])
        for i in group:
            await self._finish(sessions[i], i, digests[i])

    async def _play_raw(self, client, group, servers, hedges):
        if not self._stored:  # there is one server: all kinds of clients must get its answers
            await self._play_calls(client, group)
            return
        stubs = RawStubs(servers, self._options_of_client.timeout)
        try:
            await asyncio.gather(*(self._play_one_raw(client, i, stubs, hedges) for i in group))
        finally:
            await stubs.close()

    async def _play_one_raw(self, client, i, stubs, hedges):
        session = (await self._open(client, [i]))[i]
        patience = self._options_of_client.retry.max_elapsed
        raw = RawSession(stubs, session.session_id, hedges, patience)
        digest = hashlib.sha256()
        async for t in self._steps(i):
            begin = time.monotonic()
            answer, address = await raw.act(observation(i, t), reward(t))
            self._count(i, digest, spikeserve.Decision.from_wire(answer), begin, address)
            if (t + 1) % EPISODE == 0:
                ended, _ = await raw.end_episode(1.0 + i)
                digest.update(repr(spikeserve.EpisodeSummary.from_wire(ended)).encode())
                self._compare(i, digest)
        address = await raw.settle()
        async with spikeserve.AsyncClient(address, self._options_of_client) as owner:
            attached = spikeserve.AsyncSession(owner, session.session_id)
            await self._finish(attached, i, digest)

    def _take(self, i, digest, decision, begin, route):
        if isinstance(decision, spikeserve.SpikeserveError):
            raise decision
        self._count(i, digest, decision, begin, route.replica.address if self._stored else "")

    def _count(self, i, digest, decision, begin, address):
        digest.update(comparable(decision).encode())
        self.decided += 1
        if self._stored:
            now = time.monotonic()
            self.answers[i].append(Answered(now, now - begin, address))

    async def _end_if_due(self, session, i, t, digest):
        if (t + 1) % EPISODE == 0:
            digest.update(repr(await session.end_episode(1.0 + i, terminated=True)).encode())
            self._compare(i, digest)

    def _compare(self, i, digest):
        episodes = self._episodes[i]
        episodes.append(digest.hexdigest())
        if self._expected is None or i in self._differing:
            return
        if self._expected._episodes[i][len(episodes) - 1] != episodes[-1]:
            self._differing.add(i)
            print(f"session {i} differs from the undisturbed run in episode {len(episodes) - 1}", flush=True)

    async def _finish(self, session, i, digest):
        state, head = comparable_state(await session.state(include_head_delta=True))
        digest.update(state.encode() + (head or b""))
        self.digests[i] = digest.hexdigest()
        await session.close()
