"""Compares a head that operators teach with the rule in NumPy, over the network, at the seat and from the robot."""

import json

import grpc
import numpy as np
import pytest
from security import fails_with
from stored_sessions import Restartable
from test_learning import HIGH, LOW, TOLERANCE, norm, policies, server  # noqa: F401

STEPS = 30
OBSERVATIONS = np.random.default_rng(7).uniform(-0.2, 0.2, (STEPS, 4))


class Corrected:
    """Normalised least mean squares on the weights of a head; `base` is the head that decides at first."""

    def __init__(self, policy, shared=False):
        self.weight, self.bias, self.shared = policy["weight"], policy["bias"], shared
        self.delta = np.zeros_like(self.weight)
        self.sums = np.zeros(
            3
        )  # squares of the errors now and at the start, and of what they compare

    def take(self, rates, action):
        """Learns from an operator's action."""
        now, start = (
            weight @ rates + self.bias
            for weight in (self.weight + self.delta, self.weight)
        )
        if action.WhichOneof("kind") == "discrete":
            target = np.eye(len(now))[action.discrete]
            predict = lambda z: np.exp(z - z.max()) / np.exp(z - z.max()).sum()
            agrees = np.argmax(now) == action.discrete
        else:
            target = (
                2 * (np.array(action.continuous.values, "f8") - LOW) / (HIGH - LOW) - 1
            )
            predict, agrees = np.tanh, False
        error, start = target - predict(now), predict(start)
        squares = [
            error @ error,
            sum((target - start) ** 2),
            target @ target + start @ start,
        ]
        self.sums = 0.999 * self.sums + squares
        if not agrees:
            rate = 0.5 * min(1.0, 2 * self.sums[1] / self.sums[2]) ** 3
            step = rate * np.outer(error, rates) / (rates @ rates)
            self.delta = self.delta + step * min(1.0, 0.5 / norm(step))
            longest = 0.5 if self.shared else 2.0 * norm(self.weight)
            self.delta *= min(1.0, longest / norm(self.delta))


class Robot:
    """A session that learns from corrections, and one beside it that tells the readout rates of each step."""

    def __init__(self, agent, policy, scope="SESSION", probed=True, **options):
        learning = {"rule": "corrections", "scope": scope}
        self.agent = agent
        self.id = agent.OpenSession(
            policy=policy, learning=learning, **options
        ).session_id
        self.probe = agent.OpenSession(policy="probe").session_id if probed else None
        self.step, self.executed = 0, {}

    def act(self):
        """Returns the readout rates and the answer, and tells what was executed in the step before."""
        request = {
            "step": self.step,
            "observation": OBSERVATIONS[self.step].tolist(),
            "reward": 1.0,
        }
        rates = None
        if self.probe is not None:
            unit = self.agent.Act(
                session_id=self.probe, **request
            ).action.continuous.values
            rates = np.round(10 * np.arctanh(np.array(unit, "f8"))) / 10
        answer = self.agent.Act(session_id=self.id, **request, **self.executed)
        assert answer == self.agent.Act(
            session_id=self.id, **request, **self.executed
        )  # learns once
        self.step, self.executed = self.step + 1, {}
        return rates, answer

    def execute(self, action, kind="OPERATOR", operator_id="anna"):
        operator = {"operator_id": operator_id} if kind == "OPERATOR" else {}
        self.executed = {
            "executed_action": action,
            "executed_source": {"kind": kind, **operator},
        }

    def state(self):
        return self.agent.GetSession(session_id=self.id, include_head_delta=True)

    def delta(self):
        return np.array(self.state().head_delta)

    def end(self):
        if self.probe is not None:
            self.agent.EndEpisode(session_id=self.probe, reward=1.0)
        ended = self.agent.EndEpisode(session_id=self.id, reward=1.0, **self.executed)
        self.step, self.executed = 0, {}
        return ended.learning

    def alone(self, episodes, steps):
        """Plays episodes without an operator, each of which returns `steps`. Returns what was learned in the last one."""
        for _ in range(episodes):
            for _ in range(steps):
                self.act()
            learning = self.end()
        return learning


def action_of(policy, step, make):
    """Returns what an operator does: not what the policy would, and at times at a bound."""
    action = make()
    if policy == "discrete":
        action.discrete = step // 3 % 2
    else:
        action.continuous.values.extend(
            [(-2.0, 0.4, 1.5)[step % 3], (5.0, 1.0)[step % 2]]
        )
    return action


@pytest.mark.parametrize("seated", [False, True])
@pytest.mark.parametrize("policy", ["discrete", "box"])
def test_a_head_follows_the_operator_by_the_rule(policies, server, policy, seated):  # noqa: F811
    robot = Robot(server.agent, policy)
    head = Corrected(policies[1][policy])
    for step in range(STEPS):
        corrects = step % 5 != 4
        if seated and corrects:
            seat = server.admin.TakeControl(
                session_id=robot.id, operator_id="anna", lease_seconds=60.0
            )
            lease = {"session_id": robot.id, "lease_id": seat.lease_id}
            server.admin.SteerSession(
                **lease, action=action_of(policy, step, type(seat.action))
            )
        rates, answer = robot.act()
        if corrects:
            action = action_of(policy, step, type(answer.action))
            head.take(rates, action)
            if seated:
                assert answer.action == action
                server.admin.ReturnControl(**lease)
            else:
                robot.execute(action)
        elif not seated:
            robot.execute(
                action_of(policy, step, type(answer.action)), "SAFETY_LAYER"
            )  # which teaches nothing
    summary = robot.end()
    assert (
        np.abs(robot.delta().reshape(head.delta.shape) - head.delta).max() <= TOLERANCE
    )
    assert norm(head.delta) > 100 * TOLERANCE and summary.rejected_updates == 0
    state = robot.state().corrections
    assert state.steps == STEPS * 4 / 5
    assert [state.disagreement, state.start_disagreement] == pytest.approx(
        head.sums[:2] / head.sums[2], rel=1e-4
    )


def test_a_fleet_learns_from_one_corrected_robot(policies, server):  # noqa: F811
    corrected, other = (Robot(server.agent, "discrete", "FLEET") for _ in range(2))
    head = Corrected(policies[1]["discrete"], shared=True)
    for step in range(10):
        rates, answer = corrected.act()
        other.act()
        action = action_of("discrete", step, type(answer.action))
        head.take(rates, action)
        corrected.execute(action)
    assert not other.delta().any()  # the running episode is not in the shared head yet
    assert corrected.end().updates > 0 and other.end().updates == 0
    shared = server.admin.GetHead(policy="discrete", include_weights=True)
    assert np.abs(np.array(shared.delta) - head.delta.ravel()).max() <= TOLERANCE
    assert (
        np.array_equal(other.delta(), np.array(shared.delta, "f4"))
        and norm(head.delta) > 100 * TOLERANCE
    )
    undo = ("--json", "admin", "undo_corrections", "--policy=discrete", "--operator=anna", "--last=5m")
    assert json.loads(server.spikectl(*undo).stdout) == {"updates": 1, "head_drift": 0.0}
    assert not other.delta().any()
    for robot in (corrected, other):
        server.agent.CloseSession(session_id=robot.id)


def test_a_server_that_is_killed_has_the_same_head_again(policies, tmp_path):  # noqa: F811
    """Beside one that is never killed."""
    states = []
    for kills in (True, False):
        with Restartable(f"file:{tmp_path}/{kills}", policies=policies[0]) as server:
            robot = Robot(server, "discrete", probed=False, durability="SYNC")
            for step in range(STEPS):
                robot.act()
                robot.execute({"discrete": step // 3 % 2})
                if kills and step % 10 == 5:
                    server.restart()
            states.append(robot.state())
    assert any(states[0].head_delta) and states[0].head_delta == states[1].head_delta
    assert str(states[0].corrections) == str(states[1].corrections)


def test_a_head_that_returns_less_than_that_before_is_tried_against_it(policies, tmp_path):  # noqa: F811
    """And both live through a kill."""
    with Restartable(f"file:{tmp_path}/store", policies=policies[0]) as server:
        robot = Robot(server, "discrete", probed=False, durability="SYNC")
        robot.alone(5, steps=10)
        for _ in range(10):
            _, answer = robot.act()
            robot.execute(type(answer.action)(discrete=1 - answer.action.discrete))
        assert not robot.end().rolled_back
        taught = robot.delta()
        assert taught.any()
        assert not robot.alone(4, steps=6).rolled_back and np.array_equal(robot.delta(), taught)
        assert robot.alone(1, steps=6).rolled_back
        assert not robot.delta().any() and robot.state().rollbacks == 1
        assert not robot.alone(4, steps=3).rolled_back
        server.restart()
        assert robot.alone(1, steps=3).rolled_back  # the one before returns even less now
        assert np.array_equal(robot.delta(), taught) and robot.state().rollbacks == 2


def test_what_an_operator_taught_a_session_is_undone(policies, tmp_path):  # noqa: F811
    """And stays so after a kill; what another one taught before stays."""
    flags = [f"--audit_log={tmp_path}/audit"]
    with Restartable(f"file:{tmp_path}/store", flags, policies[0]) as server:
        robot = Robot(server, "discrete", probed=False, durability="SYNC")
        undo = {"session_id": robot.id, "seconds": 600.0}

        def teach(operator_id, steps):
            for _ in range(steps):
                _, answer = robot.act()
                robot.execute(type(answer.action)(discrete=1 - answer.action.discrete), operator_id=operator_id)
            robot.act()

        teach("anna", 8)
        by_anna, agreement = robot.delta(), robot.state().corrections.disagreement
        teach("eve", 8)
        assert not np.array_equal(robot.delta(), by_anna)
        server.restart()
        robot.state()  # which makes the server take the session over
        assert server.admin.UndoCorrections(operator_id="bob", **undo).updates == 0
        undone = server.admin.UndoCorrections(operator_id="eve", **undo)
        assert undone.updates == 8 and undone.head_drift == robot.state().head_drift > 0
        assert np.array_equal(robot.delta(), by_anna)  # bit for bit
        assert robot.state().corrections.disagreement == agreement
        server.restart()
        assert np.array_equal(robot.delta(), by_anna)
        flags = (f"--session={robot.id}", "--operator=anna", "--last=10m")
        answer = server.spikectl("--json", "admin", "undo_corrections", *flags).stdout
        assert json.loads(answer) == {"updates": 8, "head_drift": 0.0}
        assert not robot.delta().any()
        assert (tmp_path / "audit").read_text().count('"UndoCorrections"') == 3


def test_a_session_does_not_know_its_corrections_for_ever(server):  # noqa: F811
    robot = Robot(server.agent, "discrete", probed=False)
    for step in range(12):
        _, answer = robot.act()
        action = type(answer.action)(discrete=1 - answer.action.discrete)
        robot.execute(action, operator_id=f"operator {step % 2}")
    robot.act()
    taught = robot.delta()
    with fails_with(grpc.StatusCode.FAILED_PRECONDITION, "seconds: expected a time since which"):
        server.admin.UndoCorrections(session_id=robot.id, operator_id="operator 0", seconds=600.0)
    assert np.array_equal(robot.delta(), taught)


BAD_UNDO = [
    ({"policy": "discrete", "session_id": "SESSION"}, "session_id: expected either a session or the policy", "both"),
    ({}, "session_id: expected either a session or the policy", "neither"),
    ({"policy": "discrete", "operator_id": ""}, "operator_id: expected 1 to 128 bytes", "0"),
    ({"policy": "discrete", "operator_id": "a" * 129}, "operator_id: expected 1 to 128 bytes", "129"),
    ({"policy": "discrete", "seconds": 0.5}, "seconds: expected 1 to 86400", "0.5"),
    ({"policy": "discrete", "seconds": 1e6}, "seconds: expected 1 to 86400", "1e+06"),
    ({"policy": "discrete", "seconds": float("nan")}, "seconds: expected 1 to 86400", "nan"),
]


@pytest.mark.parametrize(("fields", "expected", "received"), BAD_UNDO)
def test_a_bad_undo_is_refused(server, fields, expected, received):  # noqa: F811
    with fails_with(grpc.StatusCode.INVALID_ARGUMENT, expected) as failure:
        server.admin.UndoCorrections(**{"operator_id": "anna", "seconds": 60.0, **fields})
    assert f"received {received}" in failure.value.details()


def test_heads_that_no_operator_teaches_have_nothing_to_undo(server):  # noqa: F811
    undo = {"operator_id": "anna", "seconds": 60.0}
    assert server.admin.UndoCorrections(policy="box", **undo).updates == 0
    with fails_with(grpc.StatusCode.NOT_FOUND, "nobody"):
        server.admin.UndoCorrections(policy="nobody", **undo)
    with fails_with(grpc.StatusCode.NOT_FOUND, "session_id"):
        server.admin.UndoCorrections(session_id="0" * 32, **undo)
    for learning, what in ((None, "that does not learn"), ({"scope": "FLEET"}, "of a fleet")):
        session = server.agent.OpenSession(policy="discrete", action_selection="SAMPLE", learning=learning)
        with fails_with(grpc.StatusCode.FAILED_PRECONDITION, what):
            server.admin.UndoCorrections(session_id=session.session_id, **undo)
        server.agent.CloseSession(session_id=session.session_id)


def test_a_random_operator_teaches_nothing_that_stays(server):  # noqa: F811
    robot = Robot(server.agent, "box")
    generator = np.random.default_rng(3)
    was_put_back = False
    for _ in range(STEPS):
        _, answer = robot.act()
        action = type(answer.action)()
        action.continuous.values.extend(generator.choice([LOW, HIGH]).tolist())
        robot.execute(action)
        was_put_back = was_put_back or (
            robot.state().rollbacks > 0 and not robot.delta().any()
        )
    assert was_put_back


@pytest.mark.parametrize(
    "field", [{"modulator": "target"}, {"discount": 0.9}, {"trace_decay": 0.5}]
)
def test_what_rewards_alone_have_is_refused(server, field):  # noqa: F811
    [name] = field
    expected = f"learning.{name}: expected unset unless rule learns from rewards"
    with fails_with(grpc.StatusCode.INVALID_ARGUMENT, expected):
        server.agent.OpenSession(
            policy="discrete", learning={"rule": "corrections", **field}
        )
