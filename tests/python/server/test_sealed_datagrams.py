"""Datagrams of robots and of attackers: what has the seal of a session is a step of it, and nothing else is answered."""

import json

import grpc
import pytest
from made_policies import add_wide
from sealed_datagrams import Robot, chacha20, poly1305
from security import OBSERVATION, TOKENS, code_of, service_with, until
from serving import metric, page_of, refusal_at_start, running_server, series

LISTEN = "--datagram_listen=127.0.0.1:0"


@pytest.fixture(scope="module")
def server():
    with running_server(flags=[LISTEN]) as started:
        yield started


@pytest.fixture
def robot(server):
    robot = Robot(server, server.agent.OpenSession(policy="cartpole", datagrams=True))
    yield robot
    robot.close()


def outcomes(server):
    """Returns how many datagrams had each outcome."""
    names = ("taken", "malformed", "unknown_key", "replayed", "forged", "refused")
    return {name: metric(server, "spikeserve_datagrams_total", outcome=name) for name in names}


def await_outcomes(server, before, **expected):
    """Waits until so many datagrams more have these outcomes, and no other ones."""
    wanted = {name: before[name] + expected.get(name, 0) for name in before}
    until(lambda: sum(outcomes(server).values()) >= sum(wanted.values()))
    assert outcomes(server) == wanted


def calls(server):
    """Returns how many requests of ActStream were counted."""
    return sum(series(server, "spikeserve_rpc_duration_seconds_count", method="ActStream"))


def test_the_cipher_is_that_of_the_rfc():
    """RFC 8439, 2.4.2 and 2.5.2."""
    text = b"Ladies and Gentlemen of the class of '99: If I could offer you only one tip for the future, sunscreen would be it."
    sealed = chacha20(bytes(range(32)), 1, bytes.fromhex("000000000000004a00000000"), text)
    assert sealed[:16].hex() == "6e2e359a2568f98041ba0728dd0d6981" and sealed[-2:].hex() == "874d"
    key = bytes.fromhex("85d6be7857556d337f4452fe42d506a80103808afb0db2fd4abff6af4149f51b")
    assert poly1305(key, b"Cryptographic Forum Research Group").hex() == "a8061dc1305136c6c22b8baf0c0127a9"


def test_a_datagram_is_a_step_of_the_session(server, robot):
    before = calls(server)
    for step in range(3):
        answer = robot.act(step, step=step, observation=OBSERVATION)
        assert answer.step == step and not answer.HasField("error")
    assert server.agent.Act(session_id=robot.session, step=3, observation=OBSERVATION).step == 3
    assert server.agent.EndEpisode(session_id=robot.session).steps == 4
    assert calls(server) == before + 3


def test_the_page_of_a_session_says_how_its_steps_come(server, robot):
    def transport():
        return json.loads(page_of(server, f"/session.json?session={robot.session}"))["transport"]

    assert transport() == "gRPC"
    robot.act(0, step=0, observation=OBSERVATION)
    assert transport() == "datagrams"
    server.agent.Act(session_id=robot.session, step=1, observation=OBSERVATION)
    assert transport() == "gRPC"


def test_a_copy_is_answered_and_counts_once(server, robot):
    before = calls(server)
    for _ in range(2):
        robot.send(robot.sealed(7, observation=OBSERVATION))
    answers = [robot.receive() for _ in range(2)]
    assert answers[0] == answers[1] and answers[0][0] == 7
    assert calls(server) == before + 1


def test_answers_go_to_the_newest_address_and_not_to_a_thief(server, robot):
    before = outcomes(server)
    first = robot.sealed(0, step=0, observation=OBSERVATION)
    robot.send(first)
    assert robot.receive()[1].step == 0
    moved = Robot(server, robot.opened, sealer=robot)
    assert moved.act(1, step=1, observation=OBSERVATION).step == 1
    robot.send(first)  # was recorded, and comes from elsewhere
    await_outcomes(server, before, taken=2, replayed=1)
    assert moved.act(2, step=2, observation=OBSERVATION).step == 2
    assert not robot.has_received()
    moved.close()


def test_nothing_is_answered_to_what_does_not_authenticate(server, robot):
    before = outcomes(server)
    good = robot.sealed(0, observation=OBSERVATION)

    def changed(at):
        return good[:at] + bytes([good[at] ^ 3]) + good[at + 1 :]

    for datagram in (changed(0), changed(1), changed(20), changed(len(good) - 1), good[:16], b"", b"\1" * 1300):
        robot.send(datagram)
    await_outcomes(server, before, malformed=4, unknown_key=1, forged=2)
    assert not robot.has_received()
    assert robot.act(1, observation=OBSERVATION).step == 0  # nothing has played it


def test_a_key_ends_with_its_session(server, robot):
    assert robot.act(0, observation=OBSERVATION).step == 0
    server.agent.CloseSession(session_id=robot.session)
    before = outcomes(server)
    robot.send(robot.sealed(1, step=1, observation=OBSERVATION))
    await_outcomes(server, before, unknown_key=1)
    assert not robot.has_received()


def test_a_key_plays_no_other_session(server, robot):
    other = server.agent.OpenSession(policy="cartpole").session_id
    answer = robot.act(0, session_id=other, observation=OBSERVATION)
    assert answer.error.code == grpc.StatusCode.INVALID_ARGUMENT.value[0]
    assert answer.error.message.startswith("session_id: expected that of the channel")


def test_a_key_ends_with_its_token(tmp_path):
    tokens = tmp_path / "tokens.json"
    tokens.write_text(json.dumps(TOKENS))
    with running_server(flags=[LISTEN, f"--tokens={tokens}"]) as server, service_with(server, "agent") as agent:
        robot = Robot(server, agent.OpenSession(policy="cartpole", datagrams=True))
        assert robot.act(0, observation=OBSERVATION).step == 0
        tokens.write_text(json.dumps(TOKENS | {"tokens": TOKENS["tokens"][1:]}))
        until(lambda: code_of(agent.ListPolicies) == grpc.StatusCode.UNAUTHENTICATED)
        robot.send(robot.sealed(1, step=1, observation=OBSERVATION))
        until(lambda: sum(series(server, "spikeserve_datagrams_total", "machine", outcome="unknown_key")) == 1)
        assert not robot.has_received()
        robot.close()


def test_an_answer_that_does_not_fit_is_an_error(tmp_path):
    add_wide(tmp_path, actions=400)
    with running_server(tmp_path, flags=[LISTEN]) as server:
        robot = Robot(server, server.agent.OpenSession(policy="wide", datagrams=True))
        answer = robot.act(0, observation=OBSERVATION)
        assert answer.error.code == grpc.StatusCode.OUT_OF_RANGE.value[0]
        stored = server.agent.Act(session_id=robot.session, observation=OBSERVATION)
        assert len(stored.action_probabilities) == 400
        robot.close()


def test_a_server_without_a_port_offers_no_channel():
    with running_server() as server:
        assert not server.agent.OpenSession(policy="cartpole", datagrams=True).HasField("datagrams")


@pytest.mark.parametrize(
    ("flags", "error"),
    [
        (["--datagram_listen=0.0.0.0:0", "--datagram_advertise=robots.example:1"], "--datagram_listen: expected --tokens"),
        (["--datagram_listen=0.0.0.0:0", "--insecure_network"], "--datagram_advertise: expected the HOST:PORT that robots reach"),
        (["--datagram_advertise=robots.example:1"], "--datagram_advertise: expected none without --datagram_listen"),
        (["--datagram_listen=here"], "--datagram_listen: expected HOST:PORT"),
    ],
)
def test_flags_that_do_not_fit_are_refused(flags, error):
    assert error in refusal_at_start(*flags)
