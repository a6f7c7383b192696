"""Clients find out that a connection is dead, and replace it, while calls and streams continue."""

import asyncio
import os
import socket
import subprocess
import threading
import time

import pytest
import spikeserve
from links import Link
from security import until
from spikeserve.lines import MISSES, SILENCE_SECONDS, Doubt
from spikeserve.wire import message_class
from restartable_server import restartable_server
from test_python_retries import finish

OBSERVATION = [0.01, -0.02, 0.03, 0.04]
PERIOD = 0.02


@pytest.fixture(params=[spikeserve.Client, spikeserve.AsyncClient])
def play(link, request):
    """Returns a function that runs scenario(client, session) over the link."""

    def run(scenario, options=None):
        async def run_scenario():
            client = request.param(link.address, options)
            session = await finish(client.open_session("cartpole"))
            await scenario(client, session)
            await finish(session.close())
            await finish(client.close())

        asyncio.run(run_scenario())

    return run


def test_a_call_survives_a_connection_that_a_nat_has_forgotten(link, play):
    async def scenario(client, session):
        assert (await finish(session.act(OBSERVATION))).step == 0
        link.forget()
        # Each attempt may take a minute, and keepalive is as good as off: only a fresh connection helps.
        assert (await finish(session.act(OBSERVATION, 1.0))).step == 1
        assert link.accepted == 2
        assert (await finish(session.act(OBSERVATION, 1.0))).step == 2
        summary = await finish(session.end_episode(1.0))
        assert (summary.steps, summary.episode_return) == (3, 3.0)

    play(scenario, spikeserve.ClientOptions(timeout=60, keepalive=600))


def test_calls_with_short_deadlines_find_a_fresh_connection(link, play):
    async def scenario(client, session):
        await finish(session.act(OBSERVATION))
        link.forget()
        while session.step < 5:
            try:
                await finish(session.act(OBSERVATION, 1.0, timeout=PERIOD))
            except (spikeserve.DeadlineExceededError, spikeserve.UnavailableError):
                await asyncio.sleep(0)  # for the tasks of the client
        assert link.accepted == 2

    play(scenario, spikeserve.ClientOptions(keepalive=600))


def test_a_stream_survives_a_connection_that_a_nat_has_forgotten(link, play):
    async def scenario(client, session):
        stream = client.act_stream()
        assert (await finish(stream.act(session, OBSERVATION))).step == 0
        link.forget()
        assert (await finish(stream.act(session, OBSERVATION, 1.0))).step == 1
        assert (await finish(stream.act(session, OBSERVATION, 1.0))).step == 2
        stream.close()
        assert link.accepted == 2

    play(scenario, spikeserve.ClientOptions(timeout=60, keepalive=600))


def test_keepalive_ends_a_connection_that_no_call_doubts(link, play):
    async def scenario(client, session):
        stream = client.act_stream()
        await finish(stream.act(session, OBSERVATION))
        link.forget()
        # The stream is open, and nobody waits for an answer.
        await asyncio.to_thread(until, lambda: client_sockets(link) == 0)
        assert (await finish(stream.act(session, OBSERVATION, 1.0))).step == 1
        stream.close()

    play(scenario, spikeserve.ClientOptions(keepalive=0.1, keepalive_timeout=0.2))


def test_a_slow_server_keeps_its_connection(play, link):
    async def scenario(client, session):
        await finish(session.act(OBSERVATION))
        link.cut()  # neither the old connection nor a fresh one gets an answer
        waiting = asyncio.create_task(asyncio.to_thread(time.sleep, 1.5))
        calls = [asyncio.create_task(_act(session)), waiting]
        await waiting
        link.heal()
        assert (await calls[0]).step == 1

    async def _act(session):
        act = session.act
        if isinstance(session, spikeserve.Session):
            return await asyncio.to_thread(act, OBSERVATION, 1.0)
        return await act(OBSERVATION, 1.0)

    play(scenario, spikeserve.ClientOptions(timeout=60, keepalive=600))


class ObservedLink(Link):
    """Tells when a health check has passed."""

    def __init__(self, target):
        super().__init__(target)
        self.checked = threading.Event()

    def pieces(self, pipe):
        for data in super().pieces(pipe):
            yield data
            if b"\x00\x00\x00\x00\x02\x08\x01" in data:  # SERVING, as a message of gRPC
                self.checked.set()


@pytest.mark.parametrize("kind", [spikeserve.Client, spikeserve.AsyncClient])
def test_a_line_that_answers_a_moment_later_is_kept(address, kind, monkeypatch):
    for module in ("connection", "async_connection"):
        for limit in ("GRACE_SECONDS", "RACE_SECONDS"):  # a busy machine may need longer
            monkeypatch.setattr(f"spikeserve.{module}.{limit}", 60.0)

    async def scenario(link):
        client = kind(link.address, spikeserve.ClientOptions(timeout=60, keepalive=600, retry=once))
        session = await finish(client.open_session("cartpole"))
        await finish(session.act(OBSERVATION))
        link.forget()
        late = threading.Thread(target=lambda: link.checked.wait() and link.remember())
        late.start()
        # A call that is cancelled would not be made again.
        assert (await finish(session.act(OBSERVATION, 1.0))).step == 1
        late.join()
        assert link.accepted == 2
        await finish(session.close())
        await finish(client.close())

    once = spikeserve.RetryOptions(max_attempts=1)
    with ObservedLink(address) as link:
        asyncio.run(scenario(link))


def client_sockets(link):
    """Returns the number of open connections of this process to the link."""
    port = int(link.address.rpartition(":")[2])
    return sum(1 for peer in _peers() if peer == port)


def _peers(option=None):
    """Yields the port of the peer of each TCP socket of this process, or a pair with the value of an option."""
    for name in os.listdir("/proc/self/fd"):
        try:
            if not os.readlink(f"/proc/self/fd/{name}").startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(name))) as copy:
                port = copy.getpeername()[1]
                if option is None:
                    yield port
                else:
                    yield port, copy.getsockopt(socket.IPPROTO_TCP, option)
        except (OSError, IndexError, TypeError):
            continue


def test_the_acknowledgement_of_bytes_has_a_time_limit(link, play):
    async def scenario(client, session):
        await finish(session.act(OBSERVATION))
        port = int(link.address.rpartition(":")[2])
        limits = {limit for peer, limit in _peers(socket.TCP_USER_TIMEOUT) if peer == port}
        assert limits == {7000}

    play(scenario, spikeserve.ClientOptions(keepalive_timeout=7))


@pytest.mark.parametrize("mode", ["calls", "batch", "stream"])
def test_the_cpp_client_replaces_a_connection_that_a_nat_has_forgotten(link, mode):
    command = [os.environ["CLIENT_PLAYER_PROGRAM"], link.address, mode]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes) as player:

        def ask(*words):
            print(*words, file=player.stdin, flush=True)
            return player.stdout.readline().strip()

        opening = message_class("OpenSessionRequest")(policy="cartpole")
        assert not ask("open", opening.SerializeToString().hex()).startswith("error")
        act = message_class("ActBatchRequest")()
        act.requests.add(observation=OBSERVATION, reward=1.0)
        for step in range(6):
            if step == 3:
                link.forget()
                began = time.monotonic()
            answer = ask("act", act.SerializeToString().hex())
            assert not answer.startswith("error"), answer
            result = message_class("ActBatchResponse").FromString(bytes.fromhex(answer)).results[0]
            assert result.response.step == step
        # The keepalive of HTTP/2 would take 15 s.
        assert time.monotonic() - began < 10
        assert link.accepted == 2
        assert ask("close", 0) == "ok"
        player.stdin.close()
        assert player.wait() == 0


def test_a_session_that_was_lost_closes_in_silence():
    with restartable_server() as server, spikeserve.Client(server.address) as client:
        with client.open_session("cartpole") as session:
            session.act(OBSERVATION)
            server.restart()
            with pytest.raises(spikeserve.SessionLostError):
                session.act(OBSERVATION, 1.0)
        session.close()


@pytest.mark.parametrize("field", ["keepalive", "keepalive_timeout"])
def test_the_settings_are_checked(field):
    with pytest.raises(ValueError, match=f"{field}: expected more than 0, received 0"):
        spikeserve.ClientOptions(**{field: 0})


def test_a_race_begins_after_a_silence_and_some_misses():
    doubt = Doubt()
    now = time.monotonic()
    long_ago = now - 2 * SILENCE_SECONDS
    assert not doubt.waits(now)
    assert not any(doubt.missed(long_ago) for _ in range(MISSES - 1))
    assert doubt.missed(long_ago)
    assert not doubt.missed(long_ago)  # while the race is on
    doubt.raced(fresh_won=False)
    assert not doubt.waits(long_ago)  # in the pause after it
    doubt.answered()
    assert not any(doubt.missed(long_ago) for _ in range(MISSES))  # they began before the answer
