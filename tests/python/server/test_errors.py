"""Every error of the wire contract: the code and the message that a client receives. A refused call changes nothing."""

import math

import grpc
import pytest
from security import OBSERVATION, POLICY, fails_with
from serving import DEADLINE_SECONDS, method_of, running_server

EXHAUSTED = grpc.StatusCode.RESOURCE_EXHAUSTED
INVALID = grpc.StatusCode.INVALID_ARGUMENT
NOT_FOUND = grpc.StatusCode.NOT_FOUND
PRECONDITION = grpc.StatusCode.FAILED_PRECONDITION
SAMPLED = {"action_selection": "SAMPLE"}

OPENINGS = [
    ({"policy": "walker"}, NOT_FOUND, '], received "walker"'),
    *(
        ({"version": version}, NOT_FOUND, f"version: expected 0 or one of [1, 2] of policy cartpole, received {version}")
        for version in (3, -1)
    ),
    *(
        ({"target_return": target}, INVALID, "target_return: expected a finite number within float32")
        for target in (math.nan, math.inf, -1e300)
    ),
    ({"temperature": 1.0}, INVALID, "temperature: expected unset unless action_selection is SAMPLE, received 1"),
    *(
        (SAMPLED | {"temperature": temperature}, INVALID, "temperature: expected a finite number above 0")
        for temperature in (0.0, -1.0, math.nan, math.inf, 1e-300)
    ),
    ({"action_selection": 7}, INVALID, "action_selection: expected GREEDY or SAMPLE, received 7"),
    ({"labels": {"key": "x" * 257}}, INVALID, "labels: expected keys and values of at most 256 bytes, received one of 257"),
    ({"labels": {str(i): "" for i in range(33)}}, INVALID, "labels: expected at most 32, received 33"),
]
LEARNING = [
    ({"scope": "FLEET", "max_drift": 5.0}, "max_drift: expected unset unless scope is SESSION"),
    ({"scope": 7}, "scope: expected SESSION or FLEET, received 7"),
    ({"rule": "sarsa"}, 'rule: expected policy_gradient, hebbian, hebbian_action or corrections, received "sarsa"'),
    ({"modulator": "dopamine"}, 'modulator: expected target or realized, received "dopamine"'),
    *(({"learning_rate": rate}, "learning_rate: expected a finite number above 0") for rate in (-1, 0, math.inf)),
    *(({"trace_decay": decay}, "trace_decay: expected a number from 0 to 1, received ") for decay in (2, math.nan)),
    ({"discount": -0.1}, "discount: expected a number from 0 to 1, received -0.1"),
    ({"guard_margin": -1}, "guard_margin: expected a finite number of at least 0, received -1"),
    ({"clip": 0}, "clip: expected a finite number above 0"),
    ({"max_drift": math.nan}, "max_drift: expected a finite number above 0, received nan"),
    ({}, "rule: expected hebbian or hebbian_action, or action_selection SAMPLE", "pendulum"),
]
STEPS = [
    *(("Act", {"step": step}, PRECONDITION, f"step: expected 2, received {step}") for step in (-1, 0, 3)),
    *(
        ("Act", {"observation": [0.0] * size}, INVALID, f"observation: expected 4 numbers, received {size}")
        for size in (5, 0)
    ),
    ("Act", {"observation": [0.0] * 3 + [math.nan]}, INVALID, "observation[3]: expected a finite number, received nan"),
    ("Act", {"reward": -math.inf}, INVALID, "reward: expected a finite number, received -inf"),
    ("Act", {"reward": 1e300}, INVALID, "reward: expected a return-to-go within float32, received 1e+300"),
    ("EndEpisode", {"reward": math.nan}, INVALID, "reward: expected a finite number, received nan"),
    ("EndEpisode", {"target_return": math.inf}, INVALID, "target_return: expected a finite number"),
]


@pytest.mark.parametrize(("fields", "code", "message"), OPENINGS)
def test_what_is_wrong_with_an_opening_is_named(server, fields, code, message):
    with fails_with(code, message):
        server.agent.OpenSession(**{"policy": "cartpole"} | fields)


@pytest.mark.parametrize(("learning", "message", "policy"), [(*row, "cartpole")[:3] for row in LEARNING])
def test_what_is_wrong_with_learning_is_named(server, learning, message, policy):
    with fails_with(INVALID, f"learning.{message}"):
        server.agent.OpenSession(policy=policy, learning=learning)


@pytest.mark.parametrize("rule", ["hebbian", "hebbian_action"])
def test_these_rules_teach_a_box_without_samples(server, rule):
    assert server.agent.OpenSession(policy="pendulum", learning={"rule": rule}).session_id


def test_a_closed_session_makes_room_for_another():
    with running_server(flags=["--max_sessions=2"]) as server:
        session, _ = (server.agent.OpenSession(policy="cartpole").session_id for _ in range(2))
        with fails_with(EXHAUSTED, "max_sessions: expected fewer than 2 open sessions"):
            server.agent.OpenSession(policy="cartpole")
        server.agent.CloseSession(session_id=session)
        server.agent.OpenSession(policy="cartpole")


def test_too_long_a_message_is_refused_and_its_stream_goes_on():
    with running_server(flags=["--max_message_bytes=1000"]) as server:
        with fails_with(NOT_FOUND, "policy: expected"):
            server.agent.OpenSession(policy="x" * 900)
        for size, received in ((1000, "10"), (65 << 20, "681574")):
            with fails_with(EXHAUSTED, f"--max_message_bytes: expected at most 1000, received {received}"):
                server.agent.OpenSession(policy="x" * size)
        session = server.agent.OpenSession(policy="cartpole").session_id
        request, call = method_of(server.channel, POLICY, "ActStream")
        requests = [request(session_id=each, observation=OBSERVATION) for each in ("x" * 1000, session)]
        refused, answered = call(iter(requests), timeout=DEADLINE_SECONDS)
        assert refused.error.code == EXHAUSTED.value[0]
        assert refused.error.message.startswith("--max_message_bytes: expected at most 1000, received 10")
        assert not answered.HasField("error")


@pytest.mark.parametrize("method", ["Act", "EndEpisode", "GetSession", "CloseSession"])
def test_an_unknown_session_is_not_found(server, method):
    with fails_with(NOT_FOUND, whole='session_id: expected an open session, received "nobody"'):
        getattr(server.agent, method)(session_id="nobody")


def test_a_closed_session_is_not_found(server):
    session = server.agent.OpenSession(policy="cartpole").session_id
    server.agent.CloseSession(session_id=session)
    with fails_with(NOT_FOUND, session):
        server.agent.Act(session_id=session, observation=OBSERVATION)


@pytest.fixture
def session(server):
    """Opens a session that has made two decisions. Asserts that it still waits for the third one at the end."""
    opened = server.agent.OpenSession(policy="cartpole").session_id
    for step in range(2):
        server.agent.Act(session_id=opened, step=step, observation=OBSERVATION)
    yield opened
    state = server.agent.GetSession(session_id=opened)
    assert (state.step, state.decisions, state.episode) == (2, 2, 0)


@pytest.mark.parametrize(("method", "fields", "code", "message"), STEPS)
def test_what_is_wrong_with_a_step_is_named(server, session, method, fields, code, message):
    valid = {"step": 2, "observation": OBSERVATION} if method == "Act" else {}
    with fails_with(code, message):
        getattr(server.agent, method)(session_id=session, **valid | fields)


def test_an_episode_without_a_decision_has_no_end(server):
    session = server.agent.OpenSession(policy="cartpole").session_id
    with fails_with(PRECONDITION, "expected at least one decision since the last episode ended"):
        server.agent.EndEpisode(session_id=session, reward=1.0)
