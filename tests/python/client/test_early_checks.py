"""Mistakes are refused before anything is played, with a hint about what to do."""

import sys
import textwrap

import gymnasium
import numpy as np
import pytest
import spikeserve
from gymnasium import spaces
from serving import run
from spikeserve.flat_spaces import ActionMap, FlatEnvironment

FLATTEN = "gymnasium.wrappers.FlattenObservation"
OBSERVATION = [0.01, -0.02, 0.03, 0.1]
PARTS = {"position": gymnasium.spaces.Box(-5, 5, (2,)), "velocity": gymnasium.spaces.Box(-5, 5, (2,))}


class Parted(gymnasium.Wrapper):
    """CartPole whose observation is a Dict or a Tuple of two parts."""

    def __init__(self, environment, kind):
        super().__init__(environment)
        self._kind = kind
        spaces = PARTS if kind is dict else list(PARTS.values())
        self.observation_space = (gymnasium.spaces.Dict if kind is dict else gymnasium.spaces.Tuple)(spaces)

    def _parted(self, observation):
        position, velocity = observation[0::2], observation[1::2]
        if self._kind is dict:
            return {"position": position, "velocity": velocity}
        return (position, velocity)

    def reset(self, **arguments):
        observation, info = self.env.reset(**arguments)
        return self._parted(observation), info

    def step(self, action):
        observation, *rest = self.env.step(action)
        return self._parted(observation), *rest


@pytest.mark.parametrize("kind", [dict, tuple])
def test_dict_and_tuple_observations_name_the_wrapper_that_helps(client, kind):
    environment = Parted(gymnasium.make("CartPole-v1"), kind)
    with client.open_session("cartpole") as session:
        observation, _ = environment.reset(seed=0)
        with pytest.raises(ValueError, match=f"observation: expected one array .*{FLATTEN}.* received a {kind.__name__}"):
            session.act(observation)
        with client.act_stream() as stream, pytest.raises(ValueError, match=FLATTEN):
            stream.send(session, observation)
    envs = gymnasium.vector.SyncVectorEnv([lambda: Parted(gymnasium.make("CartPole-v1"), kind)] * 2)
    with pytest.raises(ValueError, match=FLATTEN):
        spikeserve.VectorSession(client, "cartpole", envs)
    envs.close()
    # `evaluate` flattens by itself, and so does the wrapper.
    for wrappers in ([], [gymnasium.wrappers.FlattenObservation]):
        evaluation = spikeserve.evaluate(
            environment, "cartpole", server=client, episodes=1, wrappers=wrappers
        )
        assert len(evaluation.episodes) == 1
    environment.close()


def test_an_environment_of_another_size_is_refused(client):
    message = r"observation space: expected shape \(4,\) for policy 'cartpole', received \(2,\)"
    with pytest.raises(ValueError, match=message):
        spikeserve.evaluate(
            "CartPole-v1",
            "cartpole",
            server=client,
            wrappers=[lambda env: gymnasium.wrappers.TransformObservation(
                env, lambda observation: observation[:2], gymnasium.spaces.Box(-5, 5, (2,))
            )],
        )


def test_a_reward_is_needed_after_step_0(client):
    message = "reward: expected one after step 0, received None"
    with client.open_session("cartpole") as session, client.act_stream() as stream:
        session.act(OBSERVATION)
        with pytest.raises(ValueError, match=message):
            session.act(OBSERVATION)
        with pytest.raises(ValueError, match=message):
            stream.act(session, OBSERVATION)
        assert session.state().step == 1
        assert session.act(OBSERVATION, 1.0).step == 1
        assert stream.act(session, OBSERVATION, 1.0).step == 2


MODULE = """
import gymnasium


def make(length=7):
    return gymnasium.make("CartPole-v1", max_episode_steps=length).unwrapped


gymnasium.register("MyQuad-v0", entry_point=make, max_episode_steps=9)
"""


def test_evaluate_takes_a_module_arguments_a_version_and_options(client, tmp_path, monkeypatch):
    (tmp_path / "quad_of_the_test.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    arguments = {"server": client, "episodes": 2}
    evaluation = spikeserve.evaluate(
        "quad_of_the_test:MyQuad-v0",
        "cartpole",
        env_kwargs={"length": 5},
        version=1,
        options=spikeserve.SessionOptions(labels={"robot": "a"}, target_return=50),
        **arguments,
    )
    assert (evaluation.env_id, evaluation.version) == ("MyQuad-v0", 1)
    assert [episode.steps for episode in evaluation.episodes] == [9, 9]
    with pytest.raises(LookupError, match="received MyQuad-v0; pass policy= to choose one"):
        spikeserve.evaluate("quad_of_the_test:MyQuad-v0", **arguments)
    with pytest.raises(spikeserve.NotFoundError, match="99"):
        spikeserve.evaluate("CartPole-v1", version=99, **arguments)
    sys.modules.pop("quad_of_the_test")


def test_evaluate_takes_an_environment_and_leaves_it_open(client):
    environment = gymnasium.make("CartPole-v1", max_episode_steps=6)
    evaluation = spikeserve.evaluate(environment, server=client, episodes=2, seed=3)
    assert (evaluation.policy, evaluation.env_id) == ("cartpole", "CartPole-v1")
    assert [episode.steps for episode in evaluation.episodes] == [6, 6]
    environment.reset(seed=0)  # it was not closed
    with pytest.raises(ValueError, match="env_kwargs: expected none with an environment"):
        spikeserve.evaluate(environment, server=client, env_kwargs={"render_mode": None})
    environment.close()


@pytest.mark.parametrize(
    "flags, message",
    [
        (["--rule=foo"], '--rule: expected policy_gradient, hebbian, hebbian_action or corrections, received "foo"'),
        (["--modulator=foo"], '--modulator: expected target or realized, received "foo"'),
        (["--scope=foo"], '--scope: expected session or fleet, received "foo"'),
        (["--learning_rate=-1"], "--learning_rate: expected a finite number above 0, received -1"),
        (["--trace_decay=2"], "--trace_decay: expected a number from 0 to 1, received 2"),
        (["--temperature=0"], "--temperature: expected a finite number above 0, received 0"),
        (["--modulator=target", "--discount=0.9"], "--discount: expected unset unless modulator is realized"),
        (["--scope=fleet", "--max_drift=1"], "--max_drift: expected unset unless scope is SESSION"),
    ],
)
def test_adapt_refuses_before_it_plays(flags, message):
    # No server listens there: the flags are checked before the connection.
    ended = run("spikectl", "adapt", "--server=127.0.0.1:1", *flags, status=1)
    assert message in ended.stderr, ended.stderr


def test_evaluate_needs_gymnasium_only_for_an_id():
    script = textwrap.dedent(
        """
        import sys
        sys.modules["gymnasium"] = None
        import spikeserve
        print(spikeserve.evaluate.__name__)
        """
    )
    out = run(sys.executable, "-c", script)
    assert out.stdout == "evaluate\n"


def test_plain_sequences_are_still_observations(client):
    with client.open_session("cartpole") as session:
        assert session.act(tuple(OBSERVATION)).step == 0
        assert session.act(np.array(OBSERVATION), 1.0).step == 1


BOUNDS = [0.1, 0.3, 0.7, 2.0, 1 / 3, np.pi, 12.6, 1e-12, 1e30]
INTEGERS = [
    (np.uint8, 0, 255),
    (np.int32, -(2**31), 2**31 - 1),
    (np.int32, 0, 2**24 + 1),
    (np.int64, 0, 2**62),
    (np.int64, -(2**63), 2**63 - 1),
    (np.uint64, 0, 2**64 - 1),
]


@pytest.mark.parametrize("bound", BOUNDS)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_bounds_become_the_bounds_of_the_environment(bound, dtype):
    native = spaces.Box(-bound, bound, (2,), dtype)
    actions = ActionMap(native)
    np.testing.assert_array_equal(actions.to_native(actions.space.low), native.low)
    np.testing.assert_array_equal(actions.to_native(actions.space.high), native.high)
    for share in np.linspace(0, 1, 33, dtype=np.float32):
        values = actions.space.low + share * (actions.space.high - actions.space.low)
        for near in (values, np.nextafter(values, np.float32(0)), np.nextafter(values, actions.space.high)):
            assert native.contains(actions.to_native(near)), near


def test_bounds_that_float32_cannot_hold_are_refused():
    with pytest.raises(ValueError, match="action_space: expected finite bounds in float32"):
        ActionMap(spaces.Box(-1e300, 1e300, (1,), np.float64))


@pytest.mark.parametrize(("dtype", "low", "high"), INTEGERS)
def test_the_largest_integer_is_not_the_smallest(dtype, low, high):
    native = spaces.Box(low, high, (1,), dtype)
    actions = ActionMap(native)
    assert actions.to_native(actions.space.high).tolist() == [high]
    assert actions.to_native(actions.space.low).tolist() == [low]
    middle = (actions.space.low / 2 + actions.space.high / 2).astype(np.float32)
    assert native.contains(actions.to_native(middle))


def test_an_environment_receives_what_its_space_contains():
    environment = gymnasium.make("Pendulum-v1")
    native = spaces.Box(-0.1, 0.1, (1,), np.float64)
    environment.unwrapped.action_space = native
    received = []

    class Receiver(gymnasium.ActionWrapper):
        def action(self, action):
            received.append(action)
            return action

    with FlatEnvironment(Receiver(environment)) as flat:
        flat.reset(seed=0)
        flat.step(flat.action_space.high)
    assert native.contains(received[0])


def test_masked_actions_and_observations_are_refused():
    actions = ActionMap(spaces.Box(-1, 1, (2,)))
    expected = "expected numbers, received a masked array without 1 of its numbers"
    with pytest.raises(ValueError, match=f"action: {expected}"):
        actions.to_flat(np.ma.masked_array([0.0, 0.5], [True, False]))
