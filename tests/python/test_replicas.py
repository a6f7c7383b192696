"""The Python client on three replicas: whichever of them is lost, its user sees late answers and nothing else."""

import asyncio
import concurrent.futures
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


async def play(server, player_class, durability, disturb=lambda t: None):
    """Plays all sessions and returns everything that they answered, by session."""
    is_async = issubclass(player_class, AsyncCalls)
    client = (spikeserve.AsyncClient if is_async else spikeserve.Client)(server, OPTIONS)
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
        remembered = session.cursor._unacknowledged._answered[-2].answer
        remembered.action.discrete = 1 - remembered.action.discrete
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
        sessions = [client.open_session("cartpole", options) for _ in range(SESSIONS)]
        for t in range(3):
            batch = client.act_batch(sessions, [observation(0, t)] * SESSIONS, [0.0] * SESSIONS)
            assert [decision.step for decision in batch] == [t] * SESSIONS
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
    """The C++ client computes the same numbers: tests/unit/client/replicas_test.cc."""
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


@pytest.mark.parametrize("durability", ["ASYNC", "SYNC"])
def test_the_state_of_a_session_whose_episode_ended_elsewhere(fleet, durability):
    """A former owner has all decisions, but not the end of the episode."""
    first, second = fleet.replicas[:2]
    with (
        spikeserve.Client(first.address, OPTIONS) as former,
        spikeserve.Client(second.address, OPTIONS) as present,
    ):
        session = former.open_session("cartpole", options_of(3, durability))
        for t in range(3):
            session.act(observation(3, t), reward(t))
        until(lambda: store_has(fleet, session, 3))
        # As if the client had gone to the second replica for the end of the episode, and then back.
        session._client = present
        session.end_episode(1.0, terminated=True)
        expected = comparable_state(session.state(include_head_delta=True))
        session._client = former
        assert comparable_state(session.state(include_head_delta=True)) == expected


def test_the_journal_of_a_session_that_moves_all_the_time_stays_short(fleet):
    """Each owner writes one entry, and still a snapshot follows after sixteen of them."""
    with (
        spikeserve.Client(fleet.replicas[0].address, OPTIONS) as first,
        spikeserve.Client(fleet.replicas[1].address, OPTIONS) as second,
    ):
        session_id = first.open_session("cartpole", options_of(0, "SYNC")).session_id
        lengths = []
        for t in range(40):
            session = spikeserve.Session((first, second)[t % 2], session_id, step=t)
            session.act(observation(0, t), reward(t))
            lengths.append(journal_length(fleet, session_id))
        assert max(lengths) == 16, lengths


def journal_length(fleet, session_id):
    """Returns how many records Redis has of a session, whose list has the name of its last epoch."""
    script = f"local names = redis.call('KEYS', 'ss:{{{session_id}}}:[0-9]*') return redis.call('LLEN', names[1])"
    return fleet.redis.command(f'EVAL "{script}" 0')


def store_has(fleet, session, decisions):
    """Returns whether Redis has the decisions of a session: its journal has a snapshot and an entry for each."""
    return fleet.redis.command(f"LLEN ss:{{{session.session_id}}}:1") == decisions + 1


def test_a_replica_that_was_stopped_sends_no_stale_answer(fleet):
    """It receives a request, is stopped before it appends, and goes on when another one owns the session."""
    impatient = spikeserve.ClientOptions(
        timeout=DEADLINE_SECONDS, retry=spikeserve.RetryOptions(max_attempts=1)
    )
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
