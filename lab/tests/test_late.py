"""The environments and experts of recipes whose decisions take effect some beats later."""

import gymnasium
import late
import pytest


def play_late(name, expert, beats, seed):
    """Returns what the expert chose, what was executed and the return, with a delay of some beats."""
    environment = gymnasium.make(name)
    observation, _ = environment.reset(seed=seed)
    robot = environment.unwrapped
    robot.under_way = [robot.neutral] * beats
    chosen, executed, rewards, over = [], [], [], False
    while not over:
        chosen.append(expert(robot, observation))
        observation, reward, terminated, truncated, _ = environment.step(chosen[-1])
        executed.append(robot.executed)
        rewards.append(reward)
        over = terminated or truncated
    return chosen, executed, sum(rewards)


@pytest.mark.parametrize("beats", [0, 3, 4])
def test_the_experts_of_late_environments_bear_the_delay(beats):
    chosen, executed, episode_return = play_late("LateCartPole-v0", late.balance, beats, seed=3)
    assert executed == [0] * beats + chosen[: 500 - beats]
    assert episode_return == 500
    _, _, episode_return = play_late("LatePendulum-v0", late.swing_up, beats, seed=3)
    assert episode_return > -450  # the usual expert, asked 3 beats ago, returns about -640


def test_a_late_environment_draws_every_delay():
    environment = gymnasium.make("LatePendulum-v0")
    delays = set()
    for seed in range(40):
        environment.reset(seed=seed)
        delays.add(len(environment.unwrapped.under_way))
    assert delays == {0, 1, 2, 3, 4, 5}
