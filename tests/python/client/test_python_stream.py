"""Streams return the same decisions as single calls, blocking and with asyncio."""

import asyncio

import pytest
import spikeserve

SESSIONS = 3
STEPS = 20


@pytest.fixture
def client(address):
    with spikeserve.Client(address) as opened:
        yield opened


def observation(agent, step):
    return [0.01 * step, 0.1 * agent, -0.003 * step, 0.02]


def comparable(decision):
    """Returns the fields of a decision that do not depend on time."""
    return (
        decision.step,
        decision.action,
        decision.action_probabilities.tolist(),
        decision.return_to_go,
        decision.stats.spikes_by_stage,
    )


@pytest.fixture
def expected(client):
    """Returns the decisions of each agent from single calls."""
    decisions = []
    for agent in range(SESSIONS):
        with client.open_session("cartpole") as session:
            decisions.append(
                [comparable(session.act(observation(agent, t), 1.0)) for t in range(STEPS)]
            )
    return decisions


def test_many_sessions_share_a_stream(client, expected):
    sessions = [client.open_session("cartpole") for _ in range(SESSIONS)]
    received = [[] for _ in sessions]
    with client.act_stream() as stream:
        for step in range(STEPS):
            for agent, session in enumerate(sessions):
                stream.send(session, observation(agent, step), 1.0)
            for _ in sessions:
                session, decision = stream.receive(timeout=30)
                received[sessions.index(session)].append(comparable(decision))
    assert received == expected
    for session in sessions:
        assert session.step == STEPS
        session.close()


def test_a_refused_request_does_not_end_the_stream(client):
    with client.open_session("cartpole") as session, client.act_stream() as stream:
        with pytest.raises(spikeserve.InvalidArgumentError, match="expected 4 numbers, received 1"):
            stream.act(session, [0.5], timeout=30)
        assert session.step == 0
        assert stream.act(session, observation(0, 0), timeout=30).step == 0
        assert session.step == 1


def test_one_request_a_session_is_under_way(client):
    with client.open_session("cartpole") as session, client.act_stream() as stream:
        stream.send(session, observation(0, 0))
        with pytest.raises(ValueError, match="expected no request under way"):
            stream.send(session, observation(0, 0))
        with pytest.raises(ValueError, match="expected no request under way"):
            stream.act(session, observation(0, 0))
        stream.receive(timeout=30)
        with pytest.raises(spikeserve.DeadlineExceededError):
            stream.receive(timeout=0.01)


def test_a_stream_without_a_server_raises():
    with spikeserve.Client("127.0.0.1:1") as client, client.act_stream() as stream:
        session = spikeserve.Session(client, "a session")
        stream.send(session, observation(0, 0))
        for _ in range(2):
            with pytest.raises(spikeserve.UnavailableError):
                stream.receive(timeout=30)


def test_the_async_stream(address, expected):
    async def play():
        async with spikeserve.AsyncClient(address) as client:
            sessions = [await client.open_session("cartpole") for _ in range(SESSIONS)]
            received = [[] for _ in sessions]
            async with client.act_stream() as stream, asyncio.timeout(60):
                for step in range(STEPS):
                    for agent, session in enumerate(sessions):
                        await stream.send(session, observation(agent, step), 1.0)
                    for _ in sessions:
                        session, decision = await stream.receive()
                        received[sessions.index(session)].append(comparable(decision))
                with pytest.raises(spikeserve.InvalidArgumentError):
                    await stream.act(sessions[0], [0.5], 0.0)
                assert (await stream.act(sessions[0], observation(0, STEPS), 0.0)).step == STEPS
            return received

    assert asyncio.run(play()) == expected
