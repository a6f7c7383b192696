"""Several servers share the sessions in one Redis server."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import urllib.request

import grpc
import pytest
from security import until
from serving import DEADLINE_SECONDS
from stored_sessions import (
    SESSIONS,
    Restartable,
    acting,
    comparable,
    opening,
    play,
    undisturbed_play,
)

LARGEST_LEAD = 256  # decisions of one ASYNC session that may wait for the store


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


class Redis:
    """A Redis server without files."""

    def __init__(self):
        self.port = free_port()
        self.process = subprocess.Popen(
            [
                *("redis-server", "--bind", "127.0.0.1", "--port", str(self.port)),
                *("--save", "", "--appendonly", "no", "--requirepass", "secret"),
            ],
            stdout=subprocess.DEVNULL,
        )
        until(lambda: self.command("PING") == b"+PONG")

    def command(self, *words):
        """Returns the first line of the reply."""
        with contextlib.suppress(OSError):
            with socket.create_connection(("127.0.0.1", self.port)) as connection:
                connection.sendall(b"AUTH secret\r\n" + " ".join(words).encode() + b"\r\n")
                lines = connection.makefile("rb")
                assert lines.readline() == b"+OK\r\n"
                return lines.readline().strip()
        return None

    def stop(self):
        self.process.send_signal(signal.SIGCONT)
        self.process.kill()
        self.process.wait()


pytestmark = pytest.mark.skipif(shutil.which("redis-server") is None, reason="without redis-server")


@pytest.fixture(scope="module")
def redis():
    started = Redis()
    yield started
    started.stop()


@pytest.fixture
def replicas(redis, tmp_path):
    """Two servers with one store."""
    redis.command("FLUSHALL")
    password = tmp_path / "password"
    password.write_text("secret\n")
    flags = [f"--store_password_file={password}"]
    store = f"redis://127.0.0.1:{redis.port}/1"
    with Restartable(store, flags) as first, Restartable(store, flags) as second:
        yield first, second
        redis.process.send_signal(signal.SIGCONT)
        first.close()
        second.close()


def metric(server, name):
    with urllib.request.urlopen(f"http://{server.addresses.http}/metrics") as page:
        lines = page.read().decode().splitlines()
    return float(next(line for line in lines if line.startswith(name + " ")).split()[-1])


def act(server, i, step, session=None):
    request = acting(i, 0, step)
    return server.Act(**request | ({"session_id": session} if session else {}))


def code_of_act(server, i, step):
    try:
        act(server, i, step)
    except grpc.RpcError as error:
        return error.code()
    return grpc.StatusCode.OK


def test_the_other_replica_goes_on_after_a_kill(replicas):
    first, second = replicas
    serving = [first]

    def disturb(episode, step):
        if (episode, step) in {(0, 21), (1, 5)}:
            serving[0].kill()
            serving[0] = second if serving[0] is first else first
            if (episode, step) == (0, 21):
                first.stack.close()
                first.start()

    assert play(lambda: serving[0], disturb) == undisturbed_play()
    assert metric(serving[0], 'spikeserve_store_claims_total{outcome="claimed"}') >= SESSIONS


def test_replicas_take_turns(replicas):
    """Each decision goes to the other replica, which claims the session as it is."""

    def played(session, servers):
        servers[0].OpenSession(**opening(4) | {"session_id": session})
        answers = [act(servers[step % 2], 4, step, session) for step in range(20)]
        for answer in answers:
            answer.ClearField("session_id")
        return [comparable(answer) for answer in answers]

    first, second = replicas
    assert played("a" * 32, [first, second]) == played("b" * 32, [first, first])
    assert metric(first, 'spikeserve_store_claims_total{outcome="claimed"}') == 9
    assert metric(second, 'spikeserve_store_claims_total{outcome="claimed"}') == 10


def test_a_former_owner_sends_no_answer(replicas):
    """A replica that was replaced decides, finds out, and answers UNAVAILABLE; then it has the session again."""
    first, second = replicas
    first.OpenSession(**opening(5))
    act(first, 5, 0)
    theirs = comparable(act(second, 5, 1))
    assert code_of_act(first, 5, 1) == grpc.StatusCode.UNAVAILABLE
    assert comparable(act(first, 5, 1)) == theirs
    assert metric(first, 'spikeserve_store_records_total{outcome="refused"}') == 1


def test_redis_does_not_answer(redis, replicas):
    first, second = replicas
    first.OpenSession(**opening(0))
    asynchronous = first.OpenSession(**opening(2) | {"durability": "ASYNC"}).session_id
    act(first, 0, 0)
    redis.process.send_signal(signal.SIGSTOP)
    with pytest.raises(grpc.RpcError) as error:
        act(first, 0, 1)
    assert error.value.code() == grpc.StatusCode.UNAVAILABLE
    assert "grpc-status-details-bin" in dict(error.value.trailing_metadata())
    for step in range(LARGEST_LEAD):
        act(first, 2, step, asynchronous)
    assert code_of_act(first, 2, LARGEST_LEAD) == grpc.StatusCode.UNAVAILABLE
    assert metric(first, "spikeserve_store_reachable") == 0

    redis.process.send_signal(signal.SIGCONT)
    until(lambda: code_of_act(first, 0, 1) == grpc.StatusCode.OK)
    until(lambda: code_of_act(first, 2, LARGEST_LEAD) == grpc.StatusCode.OK)
    until(lambda: act(first, 2, LARGEST_LEAD).durable_decision == LARGEST_LEAD + 1)
    first.kill()
    assert second.GetSession(session_id=asynchronous).decisions == LARGEST_LEAD + 1
    assert second.GetSession(session_id=opening(0)["session_id"]).decisions == 2


def test_redis_comes_back_empty(redis, replicas):
    """Sessions that a replica holds are written again at their next decision."""
    first, second = replicas
    first.OpenSession(**opening(7))
    for step in range(5):
        act(first, 7, step)
    redis.command("FLUSHALL")
    assert code_of_act(first, 7, 5) == grpc.StatusCode.UNAVAILABLE
    until(lambda: code_of_act(first, 7, 5) == grpc.StatusCode.OK)
    first.kill()
    assert second.GetSession(session_id=opening(7)["session_id"]).decisions == 6
    act(second, 7, 6)


def test_a_closed_session_is_closed_for_all(replicas):
    first, second = replicas
    first.OpenSession(**opening(0))
    second.CloseSession(session_id=opening(0)["session_id"])
    with pytest.raises(grpc.RpcError) as error:
        second.OpenSession(**opening(0))
    assert error.value.code() == grpc.StatusCode.ALREADY_EXISTS


def test_flags():
    program = os.environ["SPIKESERVE_PROGRAM"]

    def refusal(*flags):
        run = subprocess.run(
            [program, "--policies=/", *flags], capture_output=True, text=True, timeout=DEADLINE_SECONDS
        )
        assert run.returncode == 1
        return run.stderr

    expected = "expected memory, file:DIR or redis://HOST[:PORT][/DATABASE], received"
    for wrong in ("redis://", "redis://host:0", "redis://host/x", "file:", "disk"):
        assert expected in refusal(f"--session_store={wrong}")
    assert "--store_password_file: expected none" in refusal("--store_password_file=/x")
    assert "--store_retention: expected at least" in refusal("--store_retention=1s")
