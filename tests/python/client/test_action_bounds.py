"""Actions of a policy, mapped back, are in the space of their environment, whatever its numbers are."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from spikeserve.flat_spaces import ActionMap, FlatEnvironment

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
