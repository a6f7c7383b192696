"""What a server says when it cannot start, where it listens without tokens or TLS, and how it stops when it is told to."""

import contextlib

import grpc
import pytest
from agent_streams import AgentStream
from made_policies import add_wide
from security import HEALTH, fails_with, until
from serving import DEADLINE_SECONDS, http_call, method_of, refusal_at_start, run, running_server, series

DURATION = "expected a duration such as 250ms, 10s or 1.5m"
RECORDINGS = "--record_dir: expected a directory in which the server can create folders, received"
ACTIONS = 2000  # an answer holds one float for each: 8,000 bytes
WINDOW = 65536  # bytes that the server may send before the client reads
ANSWERS = 100  # asked for, which is more than fits
STUCK = WINDOW // (4 * ACTIONS) + 1
NOT_SERVING = 2  # HealthCheckResponse.NOT_SERVING
DRAINING = (grpc.StatusCode.UNAVAILABLE, "draining")


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--policies=/nonexistent", "--policies: /nonexistent: No such file"),
        ("--listen=50051", '--listen: expected HOST:PORT, received "50051"'),
        *(
            (f"--listen={address}", f'--listen: expected HOST:PORT, received "{address}"')
            for address in ("", ":", ":1", "host", "host:", "host:x", "host:-1", "host:65536", "host:80s")
        ),
        *((f"--listen={address}", "--listen: expected HOST:PORT") for address in ("a b:1", "::1:80", "a,b:1", "[]:1")),
        *((f"--listen={address}", f"--listen: expected --tokens for {address}, ") for address in ("[2001:db8::1]:1", "my-host.invalid:1")),
        ("--http_listen=,:1", "--http_listen: expected HOST:PORT"),
        ("--session_ttl=0s", "--session_ttl: expected at least 1ms"),
        ("--session_ttl=soon", f'--session_ttl: {DURATION}, received "soon"'),
        ("--compact_after=0s", "--compact_after: expected at least 1ms"),
        ("--max_sessions=0", "--max_sessions: expected at least 1"),
        ("--max_message_bytes=0", "--max_message_bytes: expected 1 to"),
        ("--drain_timeout=-1s", "--drain_timeout: expected"),
        ("--max_streams=0", "--max_streams: expected at least 1, received 0"),
        ("--idle_timeout=0s", "--idle_timeout: expected at least 1ms, received 0"),
        ("extra", 'expected flags alone, received "extra"'),
        ("--unknown=1", "--unknown: expected a flag of spikeserve"),
        # Not even a superuser can create folders in /proc.
        ("--record_dir=/proc", f"{RECORDINGS} /proc"),
        ("--record_dir=/proc/recordings", f"{RECORDINGS} /proc/recordings"),
    ],
)
def test_a_wrong_flag_is_named_in_one_line(flag, message):
    errors = refusal_at_start(flag)
    assert message in errors
    assert errors.count("\n") == 1, errors


def test_policies_are_needed():
    assert "--policies: expected a directory, received none" in run("spikeserve", status=1).stderr


def test_a_taken_port_is_named(server):
    for flag, address in (("--listen", server.grpc), ("--http_listen", server.http)):
        assert f"{flag}: cannot listen on {address}" in refusal_at_start(f"{flag}={address}")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--listen=0.0.0.0:0"], "--listen: expected --tokens for 0.0.0.0:0"),
        (["--listen=0.0.0.0:0", "--tokens={tokens}"], "--listen: expected --tls_certificate"),
        (["--http_listen=0.0.0.0:0"], "--http_listen: expected --tokens"),
        (
            ["--http_listen=0.0.0.0:0", "--tokens={tokens}"],
            "--http_listen: expected --tls_certificate",
        ),
        (["--tls_certificate=missing.pem"], "--tls_key: expected a file"),
        (["--tls_certificate=missing.pem", "--tls_key=missing.key"], "--tls_certificate: cannot read missing.pem"),
        (["--tokens=missing.json"], "--tokens: missing.json: expected a file that can be read"),
    ],
)
def test_an_open_door_is_not_served_by_accident(tmp_path, tokens, flags, message):
    flags = [flag.format(tokens=tokens) for flag in flags]
    said = refusal_at_start("--allow_no_policies", *flags, policies=tmp_path)
    assert f"spikeserve: {message}" in said


def test_an_open_door_is_served_where_it_was_asked_for():
    with running_server(flags=["--listen=0.0.0.0:0", "--insecure_network"]) as addresses:
        assert addresses.grpc.startswith("0.0.0.0:")


@contextlib.contextmanager
def silent_server(path, *arguments, **options):
    """Starts a server and asserts that it has logged nothing when it has ended."""
    with running_server(*arguments, log=path, **options) as server:
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
    with running_server(policies, ["--drain_timeout=50ms"], log=log) as server, slow_reader(server):
        server.process.terminate()
        server.process.wait(timeout=DEADLINE_SECONDS)
    assert 'still in flight after the drain timeout drain_timeout="50ms"' in log.read_text()
