"""The Python client on three replicas: whichever of them is lost, its user sees late answers and nothing else."""

import asyncio
import concurrent.futures
import itertools
import shutil

import pytest
import spikeserve
from replicated import (
    EPISODES,
    SESSIONS,
    STEPS,
    comparable,
    comparable_state,
    observation,
    options_of,
    policy_of,
    reward,
    running_fleet,
)
from security import until
from serving import DEADLINE_SECONDS, running_server
from spikeserve.replicas import rank

pytestmark = pytest.mark.skipif(shutil.which("redis-server") is None, reason="without redis-server")

# A stopped server is given up after a second.
OPTIONS = spikeserve.ClientOptions(timeout=1.0, retry=spikeserve.RetryOptions(max_elapsed=60))


@pytest.fixture(scope="module")
def fleet():
    with running_fleet() as started:
        yield started


class Calls:
    """Plays with one call for each decision."""

    def __init__(self, client):
        self.client = client

    async def open(self, i, durability):
        return self.client.open_session(policy_of(i), options_of(i, durability))

    async def act_all(self, sessions, t):
        return [session.act(observation(i, t), reward(t)) for i, session in enumerate(sessions)]

    async def end(self, session, i):
        return session.end_episode(1.0 + i, terminated=True)

    async def state(self, session):
        return session.state(include_head_delta=True)

    async def close(self, session):
        session.close()

    def id_of(self, session):
        return session.session_id

    def leave(self):
        """Ends what the player has started."""


class Batches(Calls):
    """Plays with one batch for each step."""

    async def act_all(self, sessions, t):
        observations = [observation(i, t) for i in range(len(sessions))]
        results = self.client.act_batch(sessions, observations, [reward(t)] * len(sessions))
        for result in results:
            if isinstance(result, spikeserve.SpikeserveError):
                raise result
        return results


class Streams(Calls):
    """Plays on one stream."""

    def __init__(self, client):
        super().__init__(client)
        self.stream = client.act_stream()

    async def act_all(self, sessions, t):
        for i, session in enumerate(sessions):
            self.stream.send(session, observation(i, t), reward(t))
        answers = dict(self.stream.receive(timeout=60) for _ in sessions)
        for answer in answers.values():
            if isinstance(answer, spikeserve.SpikeserveError):
                raise answer
        return [answers[session] for session in sessions]


class AsyncCalls(Calls):
    """Plays with concurrent calls."""

    async def open(self, i, durability):
        return await self.client.open_session(policy_of(i), options_of(i, durability))

    async def act_all(self, sessions, t):
        acts = (session.act(observation(i, t), reward(t)) for i, session in enumerate(sessions))
        return await asyncio.gather(*acts)

    async def end(self, session, i):
        return await session.end_episode(1.0 + i, terminated=True)

    async def state(self, session):
        return await session.state(include_head_delta=True)

    async def close(self, session):
        await session.close()


class AsyncStreams(AsyncCalls):
    """Plays on one stream with asyncio."""

    def __init__(self, client):
        super().__init__(client)
        self.stream = client.act_stream()

    async def act_all(self, sessions, t):
        for i, session in enumerate(sessions):
            await self.stream.send(session, observation(i, t), reward(t))
        answers = dict([await self.stream.receive() for _ in sessions])
        for answer in answers.values():
            if isinstance(answer, spikeserve.SpikeserveError):
                raise answer
        return [answers[session] for session in sessions]


PLAYERS = [Calls, Batches, Streams, AsyncCalls, AsyncStreams]


async def play(server, player_class, durability, disturb=lambda t: None, options=OPTIONS, credentials=None):
    """Plays all sessions and returns everything that they answered, by session."""
    is_async = issubclass(player_class, AsyncCalls)
    client = (spikeserve.AsyncClient if is_async else spikeserve.Client)(server, options, credentials)
    player = player_class(client)
    levels = durability if isinstance(durability, list) else [durability]
    try:
        answers = await answers_of(player, levels, disturb)
    finally:
        player.leave()
    closed = client.close()
    if is_async:
        await closed
    return answers


async def answers_of(player, levels, disturb):
    sessions = [await player.open(i, levels[i % len(levels)]) for i in range(SESSIONS)]
    answers = [[] for _ in sessions]
    for episode in range(EPISODES):
        for step in range(STEPS):
            disturb(episode * STEPS + step)
            decisions = await player.act_all(sessions, episode * STEPS + step)
            for i, decision in enumerate(decisions):
                answers[i].append(comparable(decision))
        for i, session in enumerate(sessions):
            answers[i].append(repr(await player.end(session, i)))
    for i, session in enumerate(sessions):
        answers[i].append(comparable_state(await player.state(session)))
        await player.close(session)
        await player.close(session)  # does nothing
    return answers


@pytest.fixture(scope="module")
def undisturbed():
    with running_server() as server:
        return asyncio.run(play(server.grpc, Calls, "NONE"))


def disturbing(fleet, undisturbed, player):
    """Yields a function that plays with disturbances by decision and compares the answers."""

    def run(durability, disturbances):
        def disturb(t):
            if t in disturbances:
                disturbances[t]()

        answers = asyncio.run(play(fleet.addresses, player, durability, disturb))
        assert answers == undisturbed

    yield run
    for replica in fleet.replicas:
        replica.kill()
        replica.start()


@pytest.fixture(params=PLAYERS, ids=lambda player: player.__name__)
def disturbed(fleet, undisturbed, request):
    yield from disturbing(fleet, undisturbed, request.param)


BOTH = ["ASYNC"] * 4 + ["SYNC"] * 4  # each kind of session with both levels


def test_without_a_disturbance(disturbed):
    disturbed(BOTH, {})


def test_every_replica_is_killed(fleet, disturbed):
    first, second, third = fleet.replicas

    def kill(replica):
        replica.kill()

    def replace(dead, next_dead):
        dead.start()
        next_dead.kill()

    disturbed(
        BOTH,
        {
            7: lambda: kill(first),
            20: lambda: replace(first, second),
            37: lambda: replace(second, third),
            50: third.start,
        },
    )


def test_every_replica_is_stopped(fleet, disturbed):
    first, second, third = fleet.replicas

    def exchange(stopped, other):
        stopped.resume()
        other.stop()

    disturbed(
        BOTH,
        {
            10: first.stop,
            25: lambda: exchange(first, second),
            40: lambda: exchange(second, third),
            55: third.resume,
        },
    )


def test_a_rolling_restart(fleet, disturbed):
    disturbed(BOTH, {10 + 15 * i: replica.restart for i, replica in enumerate(fleet.replicas)})


def test_what_the_store_misses_is_sent_again(fleet, disturbed):
    """The store is away while all sessions go on, over the end of an episode. Then all replicas are killed."""

    def lose():
        for replica in fleet.replicas:
            replica.kill()
        fleet.redis.start()
        for replica in fleet.replicas:
            replica.start()

    disturbed("ASYNC", {5: fleet.redis.kill, 45: lose})


def test_redis_is_killed(fleet, disturbed):
    def restart():
        fleet.redis.kill()
        fleet.redis.start()

    disturbed(BOTH, {12: restart, 44: restart})


def test_an_answer_that_changes_is_an_error(fleet):
    """Replicas that would decide otherwise are not believed."""
    with (
        spikeserve.Client(fleet.addresses, OPTIONS) as client,
        client.open_session("cartpole", options_of(0, "ASYNC")) as session,
    ):
        session.act(observation(0, 0))
        fleet.redis.kill()
        for t in range(1, 5):
            session.act(observation(0, t), reward(t))
        # As if the server had answered otherwise before it was lost.
        remembered = session.cursor._unacknowledged._answered[-2]
        answer = remembered.answer
        answer.action.discrete = 1 - answer.action.discrete
        remembered.answer_bytes = answer.SerializeToString()
        for replica in fleet.replicas:
            replica.kill()
        fleet.redis.start()
        for replica in fleet.replicas:
            replica.start()
        with pytest.raises(spikeserve.DivergedError, match="expected the answer of decision 3"):
            session.act(observation(0, 5), reward(5))
        assert session.act(observation(0, 5), reward(5)).step == 5


def test_sessions_without_a_store_stay_at_their_server(fleet):
    options = options_of(0, "NONE")
    with spikeserve.Client(fleet.addresses, OPTIONS) as client:
        count = 3 * SESSIONS  # so many that chance leaves no server out
        sessions = [client.open_session("cartpole", options) for _ in range(count)]
        for t in range(3):
            batch = client.act_batch(sessions, [observation(0, t)] * count, [0.0] * count)
            assert [decision.step for decision in batch] == [t] * count
        servers = {session.cursor.route.replica.address for session in sessions}
        assert servers == {replica.address for replica in fleet.replicas}
        for session in sessions:
            session.close()


def test_a_closed_session_is_lost_for_all(fleet):
    with spikeserve.Client(fleet.addresses, OPTIONS) as client:
        session = client.open_session("cartpole", options_of(0, "SYNC"))
        other = spikeserve.Session(client, session.session_id)
        session.close()
        with pytest.raises(spikeserve.SessionLostError):
            other.act(observation(0, 0))


def test_all_clients_rank_the_servers_equally():
    """The C++ client computes the same numbers: tests/unit/client/parts_test.cc."""
    ranks = [rank("0123456789abcdef" * 2, address) for address in ("10.0.0.1:50051", "unix:/a")]
    assert ranks == [15574301511887128372, 15821398357803811023]


def test_streams_of_sessions_without_a_store(fleet):
    with spikeserve.Client(fleet.addresses, OPTIONS) as client, client.act_stream() as stream:
        options = options_of(0, "NONE")
        here = [client.open_session("cartpole", options, route=stream.route) for _ in range(3)]
        for session in here:
            assert stream.act(session, observation(0, 0), timeout=30).step == 0
        elsewhere = [client.open_session("cartpole", options) for _ in range(SESSIONS)]
        with pytest.raises(ValueError, match="session: expected one that is stored"):
            for session in elsewhere:
                stream.act(session, observation(0, 0), timeout=30)


@pytest.fixture(params=[Streams, AsyncStreams], ids=lambda player: player.__name__)
def streams(request):
    return request.param


def test_calls_beside_a_stream_stay_with_it(fleet, streams):
    """The server that the stream prefers comes back: ends of episodes do not take the sessions there."""
    asyncio.run(stay_with_the_stream(fleet, streams))


async def stay_with_the_stream(fleet, kind):
    client = (spikeserve.AsyncClient if issubclass(kind, AsyncCalls) else spikeserve.Client)(fleet.addresses, OPTIONS)
    player = kind(client)
    sessions = [await player.open(i, "SYNC") for i in range(3)]
    await player.act_all(sessions, 0)
    ids = {player.id_of(session) for session in sessions}
    # A server from which the stream has taken them may not know that yet.
    [home] = [replica for replica in fleet.replicas if all(open_at(replica).get(i) == 1 for i in ids)]
    home.kill()
    await player.act_all(sessions, 1)
    home.start()
    others = 0
    while not open_at(home):  # until the client knows that it is back
        await player.open(len(sessions) + others, "SYNC")
        others += 1
        assert others < 1000
    [host] = [r for r in fleet.replicas if r is not home and all(open_at(r).get(i) == 2 for i in ids)]
    for i, session in enumerate(sessions):
        await player.end(session, i)
    await player.act_all(sessions, 2)
    assert not ids & open_at(home).keys()
    assert all(open_at(host)[i] == 3 for i in ids)
    player.leave()
    closed = client.close()
    if issubclass(kind, AsyncCalls):
        await closed


def open_at(replica):
    """Returns the decisions of the sessions of a server, by id."""
    with spikeserve.AdminClient(replica.address) as admin:
        return {session.session_id: session.decisions for session in admin.list_sessions(page_size=1000).sessions}


@pytest.fixture
def calls():
    return Calls


@pytest.mark.parametrize("durability", ["ASYNC", "SYNC"])
def test_the_state_of_a_session_whose_episode_ended_elsewhere(fleet, calls, durability):
    """A former owner has all decisions, but not the end of the episode."""
    two = fleet.replicas[:2]
    with spikeserve.Client(",".join(replica.address for replica in two), OPTIONS) as client:
        player = calls(client)
        asyncio.run(end_elsewhere(fleet, two, player, durability))
        player.leave()


async def end_elsewhere(fleet, replicas, player, durability):
    def owner_of(session):
        return max(replicas, key=lambda replica: rank(player.id_of(session), replica.address))

    sessions = [await player.open(i, durability) for i in range(3)]
    for t in range(3):
        await player.act_all(sessions, t)
    until(lambda: all(store_has(fleet, player.id_of(session), 3) for session in sessions))
    # Two replicas own three sessions, so one of them owns two.
    session, another = next((a, b) for a, b in itertools.combinations(sessions, 2) if owner_of(a) is owner_of(b))
    owner = owner_of(session)
    [other] = [replica for replica in replicas if replica is not owner]
    owner.stop()
    await player.close(another)  # the client finds the owner away, and does not ask it for the next call
    await player.end(session, 0)
    expected = comparable_state(await player.state(session))
    owner.resume()
    other.stop()
    try:
        assert comparable_state(await player.state(session)) == expected
    finally:
        other.resume()


def store_has(fleet, session_id, decisions):
    """Returns whether Redis has the decisions of a session: its journal has a snapshot and an entry for each."""
    epoch = fleet.redis.command(f"HGET ss:{{{session_id}}}:o epoch").decode()
    return fleet.redis.command(f"LLEN ss:{{{session_id}}}:{epoch}") == decisions + 1


def test_a_replica_that_was_stopped_sends_no_stale_answer(fleet):
    """It receives a request, is stopped before it appends, and continues when another one owns the session."""
    impatient = spikeserve.ClientOptions(timeout=DEADLINE_SECONDS, retry=spikeserve.RetryOptions(max_attempts=1))
    stopped, other = fleet.replicas[:2]
    with (
        spikeserve.Client(stopped.address, impatient) as former,
        spikeserve.Client(other.address, OPTIONS) as present,
        concurrent.futures.ThreadPoolExecutor() as threads,
    ):
        session = former.open_session("cartpole", options_of(1, "SYNC"))
        session.act(observation(1, 0))
        stopped.stop()
        late = threads.submit(session.act, observation(1, 1), reward(1))
        taken_over = spikeserve.Session(present, session.session_id, step=1)
        # Other observations than those that the former owner has received.
        answers = [comparable(taken_over.act(observation(1, t), reward(t))) for t in (7, 8)]
        stopped.resume()
        with pytest.raises(spikeserve.UnavailableError):
            late.result()
        again = spikeserve.Session(present, session.session_id, step=2)
        assert comparable(again.act(observation(1, 8), reward(8))) == answers[1]
