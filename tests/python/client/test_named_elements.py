"""Robots that name their elements: another order simply works, and another name is refused."""

import json
import re

import grpc
import gymnasium
import numpy as np
import pytest
import spikeserve
from serving import RELEASED_POLICIES, method_of, running_server
from spikeserve.feature_order import FeatureOrder
from spikeserve.piloting.robot_messages import to_robot
from spikeserve.values import action_to_wire

NAMES = ("cart_position", "cart_velocity", "pole_angle", "pole_angular_velocity")
ORDER = (2, 0, 3, 1)  # of the robot's elements
ROBOT = tuple(NAMES[i] for i in ORDER)
ACTIONS = ("push_right", "push_left")  # the robot's index 0 pushes to the right
SOLVED = 500.0


@pytest.fixture
def client(server):
    with spikeserve.Client(server.grpc) as opened:
        yield opened


def play(act, end, wire=lambda observation: observation, of_robot=lambda action: action, seed=1):
    """Plays an episode of CartPole. `wire` makes the robot's observation, and `of_robot` reverses its actions."""
    environment = gymnasium.make("CartPole-v1")
    observation, _ = environment.reset(seed=seed)
    total, reward, over = 0.0, 0.0, False
    while not over:
        action = act(wire(observation), reward).action
        observation, reward, terminated, truncated, _ = environment.step(of_robot(action))
        total += reward
        over = terminated or truncated
    end(reward)
    return total


def shuffled(observation):
    return observation[list(ORDER)]


def test_policies_have_names_units_and_a_rate(client):
    for policy in client.list_policies():
        assert len(policy.observation_features) == policy.observation_size, policy.name
        assert policy.action_features, policy.name
    cartpole = next(policy for policy in client.list_policies() if policy.name == "cartpole")
    assert tuple(feature.name for feature in cartpole.observation_features) == NAMES
    assert cartpole.observation_features[2] == spikeserve.Feature("pole_angle", "rad", -0.418, 0.418, "upright")
    assert cartpole.rate_hz == 50 and cartpole.checks_wiring


def test_policies_without_names_mean_what_they_meant(server):
    with running_server(RELEASED_POLICIES) as old, spikeserve.Client(old.grpc) as client:
        policy = client.list_policies()[0]
        assert policy.observation_features == () and policy.rate_hz is None and not policy.checks_wiring
        with client.open_session(policy.name) as session:
            assert session.act(np.zeros(policy.observation_size)).wiring is None
        with pytest.raises(spikeserve.InvalidArgumentError, match="observation_names: expected none, because"):
            client.open_session(policy.name, observation=["x"] * policy.observation_size)


def test_a_robot_in_another_order_plays_by_name(client):
    with client.open_session("cartpole", observation=ROBOT, action=ACTIONS) as session:
        total = play(session.act, session.end_episode, shuffled, lambda action: 1 - action)
    assert total == SOLVED


def test_probabilities_and_executed_actions_are_in_the_order_of_the_robot(client):
    observation = np.array([0.1, 0.2, 0.03, 0.4], np.float32)
    with client.open_session("cartpole") as plain, client.open_session("cartpole", action=ACTIONS) as named:
        for step in range(5):
            rewards = {"reward": 1.0} if step else {}
            executed = {"executed_action": 1} if step else {}
            reversed_one = {"executed_action": 0} if step else {}
            first = plain.act(observation * (step + 1), **rewards, **executed)
            second = named.act(observation * (step + 1), **rewards, **reversed_one)
            assert second.action == 1 - first.action
            np.testing.assert_array_equal(second.action_probabilities, first.action_probabilities[::-1])


def test_names_let_no_action_pass_that_is_none():
    order, space = FeatureOrder(taken_actions=np.array([1, 0])), spikeserve.Discrete(2)
    for action, index in [(1, 0), (1.0, 0), (1.7, -1), (-1, -1), ([1], -1), ("1", -1), (np.ma.masked, -1)]:
        assert to_robot(action, space, order) == index
    for action in (1.0, 1.7, np.ma.masked, np.ma.masked_array([0.0, 0.5], [True, False])):
        with pytest.raises(ValueError, match="executed_action: expected "):
            action_to_wire(order.executed(action))


def test_a_dict_goes_by_its_names(client):
    with client.open_session("cartpole") as session:
        total = play(session.act, session.end_episode, lambda x: dict(sorted(zip(NAMES, x.tolist()))))
        assert total == SOLVED
        with pytest.raises(ValueError, match="expected an element 'cart_velocity'"):
            session.act({"cart_position": 0.0})
        with pytest.raises(ValueError, match="expected only .*received 'wheel'"):
            session.act({**dict.fromkeys(NAMES, 0.0), "wheel": 1.0})


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"observation": ("x", *NAMES[1:])}, r'observation_names\[0\]: expected "cart_position", received "x"'),
        ({"observation": NAMES[:2]}, "observation_names: expected 4 names"),
        ({"observation": (NAMES[0], *NAMES[:3])}, r'observation_names\[1\]: expected "cart_velocity"'),
        ({"observation": NAMES, "observation_units": ("", "N", "", "")}, 'expected "m/s", received "N"'),
        ({"observation": NAMES, "observation_units": ("m",)}, "observation_units: expected one per name"),
        ({"action": ("left", "right")}, r'action_names\[0\]: expected "push_left", received "left"'),
        ({"rate_hz": 30.0}, "rate_hz: expected 50 within 10 %, received 30"),
        (
            {"observation": ROBOT, "observation_units": ("deg", "", "", "")},
            r'observation_units\[0\] \(pole_angle\): expected "rad", received "deg"; multiply by 0.0174533',
        ),
    ],
)
def test_other_names_units_and_rates_are_refused(client, options, expected):
    with pytest.raises(spikeserve.InvalidArgumentError, match=expected):
        client.open_session("cartpole", spikeserve.SessionOptions(**options))
    client.open_session("cartpole", spikeserve.SessionOptions(rate_hz=49.0)).close()


def test_a_client_that_cannot_reorder_is_told_the_permutation(server):
    request, open_session = method_of(server.channel, "spikeserve.v1.PolicyService", "OpenSession")
    with pytest.raises(grpc.RpcError) as refused:
        open_session(request(policy="cartpole", observation_names=ROBOT))
    assert refused.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert 'observation_names[0]: expected "cart_position", received "pole_angle"' in refused.value.details()
    assert "the policy's order is [1, 3, 0, 2] of the received elements" in refused.value.details()


def test_a_pilot_in_another_order(server):
    options = spikeserve.SessionOptions(observation=ROBOT, action=ACTIONS)
    environment = gymnasium.make("CartPole-v1")
    with (
        spikeserve.Client(server.grpc) as client,
        spikeserve.Pilot(client, "cartpole", period=0.5, session=options, local=False, max_age=60.0) as pilot,
    ):
        observation, _ = environment.reset(seed=2)
        for _ in range(100):  # an expert of nothing falls after 10
            beat = pilot.beat(shuffled(observation), 1.0)
            observation, _, terminated, _, _ = environment.step(1 - beat.action)
            assert not terminated


def test_a_vector_environment_of_dicts(client):
    class Named(gymnasium.ObservationWrapper):
        def __init__(self, environment):
            super().__init__(environment)
            self.observation_space = gymnasium.spaces.Dict(
                {name: gymnasium.spaces.Box(-np.inf, np.inf, ()) for name in NAMES}
            )

        def observation(self, observation):
            return {name: np.float32(value) for name, value in zip(NAMES, observation)}

    environments = gymnasium.vector.SyncVectorEnv([lambda: Named(gymnasium.make("CartPole-v1"))] * 2)
    with spikeserve.VectorSession(client, "cartpole", environments) as session:
        observations, _ = environments.reset(seed=3)
        actions = session.act(observations)
        for _ in range(100):
            observations, rewards, terminations, truncations, infos = environments.step(actions)
            assert not terminations.any()
            actions = session.act(observations, rewards, terminations, truncations, infos)


def test_spikectl_lists_the_features(server):
    text = server.spikectl("policies", "--features").stdout
    assert "cartpole/2 at 50 Hz within 10 %\n  observation[0] cart_position m from -4.8 to 4.8 in track\n" in text
    listed = json.loads(server.spikectl("policies", "--features", "--json").stdout)
    assert all(policy["observation_features"] for policy in listed["policies"])


def test_spikectl_explains_by_name(server):
    text = server.spikectl("explain", "--env=CartPole-v1", "--steps=3").stdout
    assert re.search(r"^observation cart_position \S+, cart_velocity \S+, pole_angle \S+, pole_angular_velocity \S+$", text, re.M)
    assert re.search(r"^action (0 push_left|1 push_right)$", text, re.M)
