"""Compares a head that operators teach with the rule in NumPy, over the network, at the seat and from the robot."""

import grpc
import numpy as np
import pytest
from restartable_server import RestartableServer
from security import fails_with
from serving import POLICY, Service
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

    def execute(self, action, kind="OPERATOR"):
        operator = {"operator_id": "anna"} if kind == "OPERATOR" else {}
        self.executed = {
            "executed_action": action,
            "executed_source": {"kind": kind, **operator},
        }

    def state(self):
        return self.agent.GetSession(session_id=self.id, include_head_delta=True)

    def delta(self):
        return np.array(self.state().head_delta)

    def end(self):
        self.agent.EndEpisode(session_id=self.probe, reward=1.0)
        return self.agent.EndEpisode(
            session_id=self.id, reward=1.0, **self.executed
        ).learning


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
    for robot in (corrected, other):
        server.agent.CloseSession(session_id=robot.id)
    server.admin.RollbackHead(policy="discrete")


def test_a_server_that_is_killed_has_the_same_head_again(policies, tmp_path):  # noqa: F811
    """Beside one that is never killed."""
    states = []
    for kills in (True, False):
        store = f"--session_store=file:{tmp_path / str(kills)}"
        restartable = RestartableServer(f"--policies={policies[0]}", store)
        restartable.start()
        try:
            with grpc.insecure_channel(restartable.address) as channel:
                robot = Robot(
                    Service(channel, POLICY),
                    "discrete",
                    probed=False,
                    durability="SYNC",
                )
                for step in range(STEPS):
                    _, answer = robot.act()
                    robot.execute(action_of("discrete", step, type(answer.action)))
                    if kills and step % 10 == 5:
                        restartable.kill()
                        restartable.start()
                        grpc.channel_ready_future(channel).result()
                states.append(robot.state())
        finally:
            restartable.kill()
    assert any(states[0].head_delta) and states[0].head_delta == states[1].head_delta
    assert str(states[0].corrections) == str(states[1].corrections)


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
