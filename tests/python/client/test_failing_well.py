"""Clients outlast restarts, broken streams and limits of a real server, or say exactly what failed."""

import asyncio
import json
import os
import re
import subprocess
import threading

import gymnasium
import numpy as np
import pytest
import spikeserve
from restartable_server import restartable_server
from serving import DEADLINE_SECONDS, running_server

OBSERVATION = [0.01, -0.02, 0.03, 0.1]
ONCE = spikeserve.ClientOptions(retry=spikeserve.RetryOptions(max_attempts=1))
STEPS = 12  # more than the limit of the tenant `slow` lets through at once


@pytest.fixture
def server():
    with restartable_server() as started:
        yield started


def after_restart(server, call):
    """Kills the server, makes the call, starts the server again, and returns what became of the call."""
    server.kill()
    outcome = []

    def run():
        try:
            outcome.append(call())
        except spikeserve.SpikeserveError as error:
            outcome.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    server.start()
    thread.join(timeout=DEADLINE_SECONDS)
    return outcome[0]


def test_a_call_outlasts_a_restart_and_says_that_the_session_is_lost(server):
    with spikeserve.Client(server.address) as client:
        session = client.open_session("cartpole")
        session.act(OBSERVATION)
        error = after_restart(server, lambda: session.act(OBSERVATION, 1.0))
        assert isinstance(error, spikeserve.SessionLostError)
        assert error.session_ids == (session.session_id,)
        for call in (session.state, session.explain, lambda: session.end_episode(1.0)):
            with pytest.raises(spikeserve.SessionLostError):
                call()
        (item,) = client.act_batch([session], [OBSERVATION], [1.0])
        assert isinstance(item, spikeserve.SessionLostError)
        with pytest.raises(spikeserve.NotFoundError) as unknown:
            client.open_session("nobody")
        assert not isinstance(unknown.value, spikeserve.SessionLostError)
        with pytest.raises(ValueError, match="expected one opened with reopen=True"):
            session.open_again()


def test_a_session_that_reopens_plays_on(server):
    options = spikeserve.SessionOptions(target_return=123.0)
    with spikeserve.Client(server.address) as client:
        with client.open_session("cartpole", options, reopen=True) as session:
            lost = session.session_id
            for _ in range(3):
                session.act(OBSERVATION, 1.0)
            decision = after_restart(server, lambda: session.act(OBSERVATION, 1.0))
            assert (decision.step, decision.return_to_go) == (0, 123.0)
            assert session.reopened == 1 and session.session_id != lost
            assert session.act(OBSERVATION, 1.0).step == 1
            error = after_restart(server, lambda: session.end_episode(1.0, terminated=True))
            assert isinstance(error, spikeserve.SessionLostError)  # with the totals of the episode
            assert session.act(OBSERVATION).step == 0


def test_asyncio_sessions_reopen(server):
    async def play():
        async with spikeserve.AsyncClient(server.address) as client:
            session = await client.open_session("cartpole", reopen=True)
            await session.act(OBSERVATION)
            server.kill()
            waiting = asyncio.create_task(session.act(OBSERVATION, 1.0))
            await asyncio.to_thread(server.start)
            return (await waiting).step, session.reopened

    assert asyncio.run(play()) == (0, 1)


@pytest.mark.parametrize("asynchronous", [False, True])
def test_rows_of_a_vector_environment_reopen(server, asynchronous):
    envs = gymnasium.make_vec("CartPole-v1", num_envs=3)
    observations = np.zeros((3, 4))
    no = np.zeros(3, bool)

    def play():
        with (
            spikeserve.Client(server.address) as client,
            spikeserve.VectorSession(client, "cartpole", envs, reopen=True) as rows,
        ):
            rows.act(observations)
            server.kill()
            server.start()
            rows.act(observations, np.ones(3), no, no)
            return [decision.step for decision in rows.decisions], [s.reopened for s in rows.sessions]

    async def play_async():
        async with spikeserve.AsyncClient(server.address) as client:
            rows = await spikeserve.AsyncVectorSession.open(client, "cartpole", envs, reopen=True)
            async with rows:
                await rows.act(observations)
                server.kill()
                server.start()
                await rows.act(observations, np.ones(3), no, no)
                return [decision.step for decision in rows.decisions], [s.reopened for s in rows.sessions]

    steps, reopened = asyncio.run(play_async()) if asynchronous else play()
    assert steps == [0, 0, 0] and reopened == [1, 1, 1]
    envs.close()


def test_a_broken_stream_used_again_is_unavailable(server):
    with spikeserve.Client(server.address, ONCE) as client, client.act_stream() as stream:
        session = client.open_session("cartpole")
        stream.act(session, OBSERVATION)
        server.kill()
        for _ in range(3):
            with pytest.raises(spikeserve.UnavailableError):
                stream.act(session, OBSERVATION, 1.0, timeout=DEADLINE_SECONDS)


def test_a_broken_stream_opens_itself_again(server):
    with spikeserve.Client(server.address) as client, client.act_stream() as stream:
        session = client.open_session("cartpole", reopen=True)
        stream.act(session, OBSERVATION)
        decision = after_restart(server, lambda: stream.act(session, OBSERVATION, 1.0))
        assert decision.step == 0 and session.reopened == 1
        assert stream.act(session, OBSERVATION, 1.0, timeout=DEADLINE_SECONDS).step == 1
        lost = client.open_session("cartpole")
        stream.act(lost, OBSERVATION)
        error = after_restart(server, lambda: stream.act(lost, OBSERVATION, 1.0))
        assert isinstance(error, spikeserve.SessionLostError)


def test_asyncio_streams_open_themselves_again(server):
    async def play():
        async with spikeserve.AsyncClient(server.address) as client, client.act_stream() as stream:
            session = await client.open_session("cartpole", reopen=True)
            steps = [(await stream.act(session, OBSERVATION)).step]
            server.kill()
            waiting = asyncio.create_task(stream.act(session, OBSERVATION, 1.0))
            await asyncio.to_thread(server.start)
            steps.append((await waiting).step)
            # A `receive` that is cancelled ends the stream, and the next one opens another.
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.01):
                    await stream.receive()
            steps.append((await stream.act(session, OBSERVATION, 1.0)).step)
            return steps

    assert asyncio.run(play()) == [0, 0, 1]


@pytest.fixture(scope="module")
def limited(tokens):
    """Serves tenant `slow`, which may make 5 decisions a second."""
    with running_server(flags=[f"--tokens={tokens}"]) as addresses:
        yield addresses.grpc


def slow(**more):
    return spikeserve.ClientOptions(token="slow", **more)


def test_a_refusal_says_when_to_come_back(limited):
    once = slow(retry=spikeserve.RetryOptions(max_attempts=1))
    with spikeserve.Client(limited, once) as client, client.open_session("cartpole") as session:
        with pytest.raises(spikeserve.ResourceExhaustedError) as refused:
            for _ in range(STEPS):
                session.act(OBSERVATION, 1.0)
        assert 0 < refused.value.retry_after <= 0.2
        with client.act_stream() as stream, pytest.raises(spikeserve.ResourceExhaustedError) as late:
            for _ in range(STEPS):
                stream.act(session, OBSERVATION, 1.0, timeout=DEADLINE_SECONDS)
        assert 0 < late.value.retry_after <= 0.2
        results = client.act_batch([session], [OBSERVATION], [1.0])
        assert isinstance(results[0], spikeserve.Decision) or results[0].retry_after > 0


def test_every_client_waits_as_long_as_the_server_asks(limited):
    with spikeserve.Client(limited, slow()) as client:
        session = client.open_session("cartpole")
        assert [session.act(OBSERVATION, 1.0).step for _ in range(STEPS)] == list(range(STEPS))
        with client.act_stream() as stream:
            last = [stream.act(session, OBSERVATION, 1.0).step for _ in range(STEPS)]
        assert last == list(range(STEPS, 2 * STEPS))
        # Requests of many sessions are under way at once.
        sessions = [client.open_session("cartpole") for _ in range(STEPS)]
        with client.act_stream() as stream:
            for robot in sessions:
                stream.send(robot, OBSERVATION)
            for _ in sessions:
                assert isinstance(stream.receive(DEADLINE_SECONDS)[1], spikeserve.Decision)
        results = client.act_batch(sessions, [OBSERVATION] * STEPS, [1.0] * STEPS)
        assert [decision.step for decision in results] == [1] * STEPS
        envs = gymnasium.make_vec("CartPole-v1", num_envs=STEPS)
        with spikeserve.VectorSession(client, "cartpole", envs) as rows:
            rows.act(np.zeros((STEPS, 4)))
            rows.act(np.zeros((STEPS, 4)), np.ones(STEPS))
        envs.close()

    async def play():
        async with spikeserve.AsyncClient(limited, slow()) as client:
            session = await client.open_session("cartpole")
            steps = [(await session.act(OBSERVATION, 1.0)).step for _ in range(STEPS)]
            async with client.act_stream() as stream:
                steps += [(await stream.act(session, OBSERVATION, 1.0)).step for _ in range(STEPS)]
            return steps

    assert asyncio.run(play()) == list(range(2 * STEPS))


def spikectl(server, *arguments, **more):
    command = [os.environ["SPIKECTL_PROGRAM"], *arguments, f"--server={server}"]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **more
    )


def test_spikectl_waits_as_long_as_the_server_asks(limited):
    environment = os.environ | {"SPIKESERVE_TOKEN": "slow"}
    run = spikectl(limited, "run", "--env=MountainCar-v0", "--policy=mountaincar", "--json", env=environment)
    # Some 100 decisions at 5 a second. The run is cut off after enough of them.
    with pytest.raises(subprocess.TimeoutExpired):
        run.communicate(timeout=5)
    run.kill()
    run.communicate()


class Saboteur(gymnasium.Wrapper):
    """Kills the server at a step of an episode, and starts it again on request."""

    def __init__(self, environment, server, episode, restart):
        super().__init__(environment)
        self._server, self._episode, self._restart = server, episode, restart
        self._episodes = self._steps = 0

    def reset(self, **arguments):
        self._episodes += 1
        self._steps = 0
        return self.env.reset(**arguments)

    def step(self, action):
        self._steps += 1
        if (self._episodes, self._steps) == (self._episode, 5):
            self._server.kill()
            if self._restart:
                self._server.start()
        return self.env.step(action)


def test_an_evaluation_keeps_what_it_had(server):
    options = spikeserve.ClientOptions(retry=spikeserve.RetryOptions(max_elapsed=0.2))
    arguments = {"env_kwargs": {"max_episode_steps": 20}, "episodes": 5}
    with spikeserve.Client(server.address, options) as client:
        with pytest.raises(spikeserve.EvaluationStoppedError) as stopped:
            spikeserve.evaluate(
                "CartPole-v1",
                server=client,
                wrappers=[lambda env: Saboteur(env, server, episode=3, restart=False)],
                **arguments,
            )
    error = stopped.value
    assert isinstance(error.__cause__, spikeserve.UnavailableError)
    assert list(error.evaluation.returns) == [20.0, 20.0]
    assert "stopped after 2 of 5 episodes: cartpole/2 plays CartPole-v1: return 20.0" in str(error)


def test_an_evaluation_plays_an_episode_again_whose_session_was_lost(server):
    evaluation = spikeserve.evaluate(
        "CartPole-v1",
        server=server.address,
        env_kwargs={"max_episode_steps": 20},
        wrappers=[lambda env: Saboteur(env, server, episode=2, restart=True)],
        episodes=3,
    )
    assert [episode.steps for episode in evaluation.episodes] == [20, 20, 20]


def test_spikectl_run_keeps_what_it_had(server):
    run = spikectl(server.address, "run", "--env=CartPole-v1", "--episodes=1000")
    lines = [run.stdout.readline() for _ in range(5)]  # two lines of head, one of columns, episodes
    server.kill()
    server.start()  # without the session
    out, errors = run.communicate(timeout=DEADLINE_SECONDS)
    assert run.returncode == 1
    played = len(re.findall(r"^ +\d+ +\d+\.\d ", "".join(lines) + out, re.MULTILINE))
    assert f"over {played} episodes" in out
    assert f"stopped after {played} of 1000 episodes: " in errors and "NOT_FOUND" in errors


def test_spikectl_run_plays_on_in_a_new_session(server):
    run = spikectl(server.address, "run", "--env=CartPole-v1", "--episodes=8", "--reopen")
    for _ in range(5):
        run.stdout.readline()
    server.kill()
    server.start()
    out, errors = run.communicate(timeout=DEADLINE_SECONDS)
    assert run.returncode == 0, errors
    assert "mean return 500.0 +- 0.0 over 8 episodes, 4000 decisions" in out


def spikeload(server, mode, duration):
    """Starts spikeload, waits until its sessions are open and kills the server."""
    load = subprocess.Popen(
        [
            os.environ["SPIKELOAD_PROGRAM"],
            f"--server={server.address}",
            f"--mode={mode}",
            "--sessions=8",
            "--streams=2",
            f"--duration={duration}",
            "--episode_steps=20",
            "--json",
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with spikeserve.AdminClient(server.address) as admin:
        while admin.list_sessions().open_sessions < 8:
            pass
    server.kill()
    return load


@pytest.mark.parametrize("mode", ["unary", "stream", "batch"])
def test_spikeload_ends_on_time(server, mode):
    load = spikeload(server, mode, "2s")
    out, errors = load.communicate(timeout=DEADLINE_SECONDS)
    assert json.loads(out)["errors"] > 0
    assert "requests failed, the first one with" in errors


@pytest.mark.parametrize("mode", ["unary", "stream", "batch"])
def test_spikeload_connects_again_in_new_sessions(server, mode):
    load = spikeload(server, mode, "10m")
    server.start()
    with spikeserve.AdminClient(server.address) as admin:
        open_sessions = decisions = 0
        while load.poll() is None and not (open_sessions == 8 and decisions):
            listed = admin.list_sessions()
            open_sessions = listed.open_sessions
            decisions = sum(session.decisions for session in listed.sessions)
    assert open_sessions == 8 and decisions > 0
    load.kill()
    load.communicate()
