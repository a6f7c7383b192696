"""A server that is told to stop answers what it has, refuses the rest, and says so on its health page."""

import contextlib

import grpc
import pytest
from agent_streams import AgentStream
from made_policies import add_wide
from security import HEALTH, fails_with, until
from serving import DEADLINE_SECONDS, http_call, method_of, running_server, series

ACTIONS = 2000  # an answer holds one float for each: 8,000 bytes
WINDOW = 65536  # bytes that the server may send before the client reads
ANSWERS = 100  # asked for, which is more than fits
STUCK = WINDOW // (4 * ACTIONS) + 1
NOT_SERVING = 2  # HealthCheckResponse.NOT_SERVING
DRAINING = (grpc.StatusCode.UNAVAILABLE, "draining")


@contextlib.contextmanager
def silent_server(path, *arguments, **options):
    """Starts a server and asserts that it has logged nothing when it has ended."""
    with path.open("wb") as log, running_server(*arguments, log=log, **options) as server:
        yield server
    assert path.read_text() == ""


def test_an_idle_server_stops(tmp_path):
    with silent_server(tmp_path / "log") as server:
        code, _, body = http_call(server.http, "GET", "/healthz")
        assert (code, body) == (200, b"SERVING\n")


def test_calls_in_flight_end(tmp_path):
    """Requests arrive while the server stops. Each one gets its whole answer, or the stream ends with UNAVAILABLE."""
    with silent_server(tmp_path / "log") as server:
        session = server.agent.OpenSession(policy="cartpole").session_id
        stream = AgentStream(server.channel)
        answered = 0
        with fails_with(*DRAINING):
            while True:
                answer = stream.act(session, answered)
                assert (answer.step, answer.HasField("error")) == (answered, False)
                answered += 1
                if answered == 100:
                    server.process.terminate()
        assert answered >= 100


@contextlib.contextmanager
def slow_reader(server):
    """Asks for more answers than the server may send, and reads none yet. Yields the stream."""
    options = [("grpc.http2.bdp_probe", 0), ("grpc.http2.lookahead_bytes", WINDOW)]  # the window keeps its size
    session = server.agent.OpenSession(policy="wide").session_id
    with grpc.insecure_channel(server.grpc, options) as channel:
        stream = AgentStream(channel)
        for _ in range(ANSWERS):
            stream.send(session, 0)
        until(lambda: sum(series(server, "spikeserve_rpc_duration_seconds_count", method="ActStream")) >= STUCK)
        yield stream


@pytest.fixture
def policies(tmp_path):
    add_wide(tmp_path / "policies", ACTIONS)
    return tmp_path / "policies"


def test_the_answer_under_way_ends_and_new_calls_are_refused(policies, tmp_path):
    with silent_server(tmp_path / "log", policies) as server, slow_reader(server) as stream:
        request, watch = method_of(server.channel, HEALTH, "Watch")
        states = watch(request(), timeout=DEADLINE_SECONDS)
        next(states)
        late = AgentStream(server.channel)
        server.process.terminate()
        assert next(states).status == NOT_SERVING
        with fails_with(*DRAINING):
            server.agent.OpenSession(policy="wide")
        with fails_with(*DRAINING):
            next(AgentStream(server.channel).call)
        with fails_with(*DRAINING):
            next(late.call)
        code, _, body = http_call(server.http, "GET", "/healthz")
        assert (code, body) == (503, b"NOT_SERVING\n")
        answers = 0
        with fails_with(*DRAINING):
            for answer in stream.call:
                assert len(answer.action_probabilities) == ACTIONS
                answers += 1
        assert STUCK <= answers < ANSWERS


def test_the_drain_timeout_ends_what_does_not_end(policies, tmp_path):
    log = tmp_path / "log"
    with log.open("wb") as file, running_server(policies, ["--drain_timeout=50ms"], log=file) as server, slow_reader(server):
        server.process.terminate()
        server.process.wait(timeout=DEADLINE_SECONDS)
    assert 'still in flight after the drain timeout drain_timeout="50ms"' in log.read_text()
