"""Compares the learning of a server with eqs. 4.1 to 4.3 in NumPy, on episodes over the network.

The readout rates, which are the input of the head, come from a second session. Its policy has the
same weights, except that its head is the identity. The action embeddings are zero, so both
sessions compute with the same tokens. The test uses only the answers of the server. It keeps every
trace in double precision and sums them as the equations are written.
"""

import json

import grpc
import gymnasium
import numpy as np
import pytest
from policy_file import read_policy, write_policy
from security import fails_with
from serving import DEPLOY, running_server

SHIPPED = DEPLOY / "policies/cartpole/2/policy.safetensors"
LOW, HIGH = np.array([-2.0, 0.0]), np.array([2.0, 5.0])
EPISODES = 3
MOST_STEPS = 60
TOLERANCE = 1e-6


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    """Writes the policies. Returns their folder, and the head and modulator statistics by policy."""
    folder = tmp_path_factory.mktemp("policies")
    tensors, metadata = read_policy(SHIPPED)
    del metadata["features"], metadata["wiring"]  # of another action space
    size = tensors["head.weight"].shape[1]
    generator = np.random.default_rng(1)
    heads = {
        "discrete": tensors["head.weight"],
        "box": generator.normal(0, 0.3, (2, size)),
        "probe": np.eye(size),
    }
    spaces = {
        "discrete": {"type": "Discrete", "n": 2},
        "box": {"type": "Box", "low": LOW.tolist(), "high": HIGH.tolist()},
        "probe": {"type": "Box", "low": [-1.0] * size, "high": [1.0] * size},
    }
    kept = {}
    for name, weight in heads.items():
        bias = np.zeros(len(weight)) if name == "probe" else generator.normal(0, 0.1, len(weight))
        edited = tensors | {
            "head.weight": weight.astype("f4"),
            "head.bias": bias.astype("f4"),
            "embed.action.weight": np.zeros((size, len(weight)), tensors["embed.action.weight"].dtype),
        }
        path = folder / name / "1" / "policy.safetensors"
        write_policy(path, edited, metadata | {"action_space": json.dumps(spaces[name])})
        kept[name] = {
            "weight": edited["head.weight"].astype("f8"),
            "bias": edited["head.bias"].astype("f8"),
            "mean": float(np.float32(metadata["modulator_mean"])),
            "std": float(np.float32(metadata["modulator_std"])),
        }
    return folder, kept


@pytest.fixture(scope="module")
def server(policies):
    with running_server(policies[0]) as started:
        yield started


@pytest.fixture(scope="module")
def policy_service(server):
    return server.agent


@pytest.fixture(scope="module")
def admin(server):
    return server.admin


def norm(matrix):
    return float(np.sqrt(np.sum(np.square(matrix))))


class Plasticity:
    """Eqs. 4.1 to 4.3. Keeps every trace of the episode."""

    def __init__(self, policy, temperature, config):
        self.base, self.bias = policy["weight"], policy["bias"]
        self.temperature = temperature
        self.realized = config["modulator"] == "realized"
        # A target modulator starts with the mean and deviation of the policy, as 1,000 decisions.
        self.mean, self.variance, self.decisions = 0.0, 0.0, 0
        if not self.realized:
            self.mean, self.variance, self.decisions = policy["mean"], policy["std"] ** 2, 1000
        self.config = {
            "learning_rate": 0.3 if self.realized else 1e-3,
            "trace_decay": 0.9,
            "discount": 0.97,
            "clip": 0.5,
            "max_drift": 2.0,
        } | config
        self.delta = np.zeros_like(self.base)
        self.start_episode()

    def start_episode(self):
        self.trace = np.zeros_like(self.base)
        self.traces = []
        self.before = None  # the trace and the delta before the last decision

    def head_delta(self):
        return self.delta

    def logits(self, rates):
        return (self.base + self.head_delta()) @ rates + self.bias

    def probabilities(self, rates):
        z = self.logits(rates) / self.temperature
        exponentials = np.exp(z - z.max())
        return exponentials / exponentials.sum()

    def postsynaptic(self, rates, action):
        """Returns the factor y of eq. 4.1. `action` is an Action message."""
        hebbian = self.config["rule"] == "hebbian"
        drawn = self.config["rule"] == "hebbian_action"
        if action.WhichOneof("kind") == "discrete":
            if drawn:
                return np.eye(2)[action.discrete]
            probabilities = self.probabilities(rates)
            return probabilities if hebbian else np.eye(2)[action.discrete] - probabilities
        z = self.logits(rates)
        if hebbian:
            return np.tanh(z)
        unit = 2 * (np.array(action.continuous.values, "f8") - LOW) / (HIGH - LOW) - 1
        if drawn:
            return unit
        with np.errstate(divide="ignore"):  # a value on its bound
            return (np.arctanh(unit) - z) / self.temperature

    def decided(self, rates, action, return_to_go):
        self.before = (self.trace, self.delta)
        self.learn(rates, self.postsynaptic(rates, action), return_to_go)

    def executed(self, rates, answered, executed, return_to_go):
        """Replaces the last decision by one for the action that was executed."""
        self.trace, self.delta = self.before
        self.traces.pop()
        y = self.postsynaptic(rates, executed)
        if executed.WhichOneof("kind") == "continuous" and self.config["rule"] != "hebbian":
            same = np.array(answered.continuous.values) == np.array(executed.continuous.values)
            y = np.where(same, self.postsynaptic(rates, answered), np.clip(y, -4, 4))
        self.learn(rates, y, return_to_go)

    def learn(self, rates, y, return_to_go):
        self.trace = self.config["trace_decay"] * self.trace + np.outer(y, rates)
        self.traces.append(self.trace)
        if not self.realized:
            modulator = np.clip((return_to_go - self.mean) / np.sqrt(self.variance), -1, 1)
            self.update(modulator * self.trace)

    def ended(self, rewards, terminated):
        discount = self.config["discount"] if self.realized else 1.0
        # After a truncated episode, the future rewards are assumed to be its mean reward.
        following = 0.0
        if not terminated and discount < 1:
            following = np.mean(rewards) / (1 - discount)
        returns = []
        for reward in reversed(rewards):
            following = reward + discount * following
            returns.insert(0, following)
        self.remember(np.array(returns))
        if self.realized:
            differences = np.array(returns) - self.mean
            scale = max(np.sqrt(self.variance), np.sqrt(np.mean(differences**2)))
            modulators = differences / scale
            self.update(sum(m * trace for m, trace in zip(modulators, self.traces)))
        self.start_episode()

    def remember(self, returns):
        """Updates mean and variance. Earlier returns have the weight of at most 1,000 decisions."""
        total = self.decisions + len(returns)
        squares = self.decisions * (self.variance + self.mean**2) + np.sum(returns**2)
        self.mean = (self.decisions * self.mean + np.sum(returns)) / total
        self.variance = squares / total - self.mean**2
        self.decisions = min(total, 1000)

    def update(self, direction):
        step = self.config["learning_rate"] * direction
        step *= min(1.0, self.config["clip"] / max(norm(step), 1e-300))
        self.delta = self.delta + step
        bound = self.config["max_drift"] * norm(self.base)
        self.delta *= min(1.0, bound / max(norm(self.delta), 1e-300))


class FleetMember(Plasticity):
    """Collects the updates of an episode and adds them to the head of the fleet at its end."""

    def __init__(self, policy, temperature, config, fleet):
        self.fleet = fleet  # {"delta": W - W_base}, shared by all members
        super().__init__(policy, temperature, config)

    def head_delta(self):
        return self.fleet["delta"]

    def update(self, direction):
        step = self.config["learning_rate"] * direction
        step *= min(1.0, self.config["clip"] / max(norm(step), 1e-300))
        self.delta = self.delta + step
        self.delta *= min(1.0, self.config["clip"] / max(norm(self.delta), 1e-300))

    def ended(self, rewards, terminated):
        super().ended(rewards, terminated)
        given = self.delta * min(1.0, 0.5 / max(norm(self.delta), 1e-300))
        total = self.fleet["delta"] + given
        total *= min(1.0, 2 * norm(self.base) / max(norm(total), 1e-300))
        self.fleet["delta"] = total
        self.delta = np.zeros_like(self.delta)


def assert_head(policy_service, session_id, plasticity):
    session = policy_service.GetSession(session_id=session_id, include_head_delta=True)
    delta = np.array(session.head_delta).reshape(plasticity.base.shape)
    expected = plasticity.head_delta()
    assert np.abs(delta - expected).max() <= TOLERANCE
    assert session.head_drift == pytest.approx(norm(expected) / norm(plasticity.base), abs=TOLERANCE)
    assert session.trace_norm == pytest.approx(norm(plasticity.trace), rel=1e-5, abs=TOLERANCE)


def play_episode(environment, policy_service, session_id, probe_id, plasticity, seed, layer=None):
    """Plays at most MOST_STEPS steps and compares the head after every answer.

    `layer` is a safety layer: it returns the action to execute in the place of an answered one, or None.
    """
    observation, _ = environment.reset(seed=seed)
    reward, rewards, step, over = 0.0, [], 0, False
    last = None  # the rates, answer and executed action of the last step, where the layer changed it
    while not over:
        request = {"step": step, "observation": observation.tolist(), "reward": reward}
        probed = request
        if last is not None:
            request = request | {"executed_action": last[2]}
            plasticity.executed(last[0], last[1].action, last[2], last[1].return_to_go)
        unit = policy_service.Act(session_id=probe_id, **probed).action.continuous.values
        # The action of the probe is tanh(spike count / 10 ticks).
        rates = np.round(10 * np.arctanh(np.array(unit, "f8"))) / 10
        answer = policy_service.Act(session_id=session_id, **request)
        discrete = answer.action.WhichOneof("kind") == "discrete"
        if discrete:
            probabilities = plasticity.probabilities(rates)
            assert np.abs(np.array(answer.action_probabilities) - probabilities).max() <= TOLERANCE
        plasticity.decided(rates, answer.action, answer.return_to_go)
        if step % 7 == 0:  # a repeated request must not learn again
            policy_service.Act(session_id=session_id, **request)
        assert_head(policy_service, session_id, plasticity)
        executed = layer(step, answer.action) if layer else None
        last = None if executed is None else (rates, answer, executed)
        right = answer.action.discrete if discrete else answer.action.continuous.values[0] > 0
        observation, _, terminated, truncated, _ = environment.step(int(right))
        # The rewards differ between steps, so credit assignment changes the result.
        reward = 1.0 - 2.0 * abs(float(observation[2]))
        rewards.append(reward)
        step += 1
        over = terminated or truncated or step == MOST_STEPS
    policy_service.EndEpisode(session_id=probe_id, reward=reward)
    ending = {"session_id": session_id, "reward": reward, "terminated": terminated}
    if last is not None:
        ending["executed_action"] = last[2]
        plasticity.executed(last[0], last[1].action, last[2], last[1].return_to_go)
    end = policy_service.EndEpisode(**ending)
    assert policy_service.EndEpisode(**ending) == end  # a repeated request must not learn again
    plasticity.ended(rewards, terminated)
    assert end.learning.updates == (step if plasticity.config["modulator"] == "target" else 1)
    assert end.learning.rejected_updates == 0
    assert end.learning.modulator_mean == pytest.approx(plasticity.mean, rel=1e-9)
    assert end.learning.modulator_std == pytest.approx(np.sqrt(plasticity.variance), rel=1e-9)
    assert_head(policy_service, session_id, plasticity)


SETTINGS = {
    "defaults": {},
    "own": {"learning_rate": 5e-3, "trace_decay": 0.7},
    "bounded": {"learning_rate": 0.05, "clip": 0.02, "max_drift": 0.03},
    "executed": {"learning_rate": 5e-3},  # with a safety layer, whose actions have the score
}
DISCOUNT = {"own": {"discount": 0.9}, "bounded": {"discount": 1.0}}  # realized modulator only


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("modulator", ["target", "realized"])
@pytest.mark.parametrize("rule", ["policy_gradient", "hebbian", "hebbian_action"])
@pytest.mark.parametrize("policy", ["discrete", "box"])
def test_the_head_follows_the_equations(policies, policy_service, policy, rule, modulator, settings):
    temperature = 0.5 if policy == "box" else 2.0
    config = {"rule": rule, "modulator": modulator} | SETTINGS[settings]
    if modulator == "realized":
        config |= DISCOUNT.get(settings, {})
    opening = {"action_selection": "SAMPLE", "temperature": temperature, "target_return": 200.0}
    session = policy_service.OpenSession(policy=policy, seed=3, learning=config, **opening)
    probe = policy_service.OpenSession(policy="probe", target_return=200.0)
    plasticity = Plasticity(policies[1][policy], temperature, config)
    layer = safety_layer if settings == "executed" else None
    environment = gymnasium.make("CartPole-v1")
    for episode in range(EPISODES):
        ids = (session.session_id, probe.session_id)
        play_episode(environment, policy_service, *ids, plasticity, episode, layer)
    environment.close()
    assert np.abs(plasticity.delta).max() > 100 * TOLERANCE
    if settings == "bounded":
        assert norm(plasticity.delta) <= 0.03 * norm(plasticity.base) + 1e-9


@pytest.mark.parametrize("modulator", ["target", "realized"])
@pytest.mark.parametrize("rule", ["policy_gradient", "hebbian", "hebbian_action"])
@pytest.mark.parametrize("policy", ["discrete", "box"])
def test_a_fleets_head_follows_the_equations(policies, policy_service, admin, policy, rule, modulator):
    admin.RollbackHead(policy=policy)
    temperature = 0.5 if policy == "box" else 2.0
    config = {"rule": rule, "modulator": modulator}
    if policy == "box":
        # An action near its bound saturates, so it does not determine the noise. A small rate avoids this.
        config["learning_rate"] = 1e-3
    opening = {"action_selection": "SAMPLE", "temperature": temperature, "target_return": 200.0}
    probe = policy_service.OpenSession(policy="probe", target_return=200.0).session_id
    fleet = {"delta": np.zeros_like(policies[1][policy]["weight"])}
    members = []
    for seed in range(3):
        learning = config | {"scope": "FLEET"}
        session = policy_service.OpenSession(policy=policy, seed=seed, learning=learning, **opening)
        member = FleetMember(policies[1][policy], temperature, config, fleet)
        members.append((session.session_id, member))
    environment = gymnasium.make("CartPole-v1")
    for episode in range(2):
        for i, (session_id, member) in enumerate(members):
            play_episode(environment, policy_service, session_id, probe, member, 10 * episode + i)
    environment.close()
    head = admin.GetHead(policy=policy, include_weights=True)
    delta = np.array(head.delta).reshape(fleet["delta"].shape)
    assert np.abs(delta - fleet["delta"]).max() <= TOLERANCE
    assert norm(delta) > 100 * TOLERANCE
    assert head.updates == 6 and head.sessions >= 3 and not head.paused
    for session_id, _ in members:  # a head with five members would gather its first window
        policy_service.CloseSession(session_id=session_id)


def safety_layer(step, answered):
    """Reverses every third index; clips the values, and puts them on a bound at times."""
    action = type(answered)()
    if answered.WhichOneof("kind") == "discrete":
        if step % 3 != 0:
            return None
        action.discrete = 1 - answered.discrete
    else:
        values = np.clip(answered.continuous.values, [-0.5, 1.0], [0.5, 2.0]).tolist()
        action.continuous.values.extend(HIGH if step % 11 == 5 else values)
    return action


def test_a_frozen_session_shows_no_learning(policy_service):
    session_id = policy_service.OpenSession(policy="discrete").session_id
    policy_service.Act(session_id=session_id, step=0, observation=[0.0] * 4)
    session = policy_service.GetSession(session_id=session_id, include_head_delta=True)
    assert session.trace_norm == 0 and session.head_drift == 0 and not session.head_delta
    end = policy_service.EndEpisode(session_id=session_id, reward=1.0)
    assert not end.HasField("learning")


@pytest.mark.parametrize("modulator", ["target", "realized"])
def test_absurd_rewards_stay_within_the_bounds(policy_service, modulator):
    config = {"modulator": modulator, "learning_rate": 1.0, "max_drift": 0.1}
    session_id = policy_service.OpenSession(policy="discrete", learning=config).session_id
    for _ in range(3):
        for step in range(20):
            reward = 1e30 * (-1) ** step
            request = {"session_id": session_id, "observation": [0.01 * step] * 4}
            if step > 0:
                with fails_with(grpc.StatusCode.INVALID_ARGUMENT):
                    policy_service.Act(step=step, reward=float("nan"), **request)
            answer = policy_service.Act(step=step, reward=reward, **request)
            assert np.isfinite(answer.action_probabilities).all()
        end = policy_service.EndEpisode(session_id=session_id, reward=1e30)
        assert 0 < end.learning.head_drift <= 0.1 + 1e-6
        assert np.isfinite(end.learning.modulator_mean)
        assert np.isfinite(end.learning.modulator_std)
