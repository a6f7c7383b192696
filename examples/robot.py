"""Swings up a pendulum at 50 Hz. The robot has an action at every control step, whatever the link does.

usage: python examples/robot.py [HOST:PORT]

Needs the Python client: pip install "./client/python[gymnasium]"
"""

import sys
import time

import gymnasium
import numpy as np
import spikeserve

PERIOD = 0.02  # seconds
WEAKER = 1.9  # Nm; the safety layer of this robot allows no more, of the 2 that the policy knows


def fly(pilot, robot, seed):
    """Plays one episode. Returns the summary that the server sends when it has every step."""
    observation, _ = robot.reset(seed=seed)
    reward, truncated, executed = 0.0, False, None
    next_step = time.monotonic()
    while not truncated:
        # Returns within half a period: the server's answer, or what the fallback order has in its place.
        action = pilot.beat(observation, reward, executed_action=executed)
        executed = np.clip(action.action, -WEAKER, WEAKER)  # the next call reports it to the server
        observation, reward, _, truncated, _ = robot.step(executed)
        next_step += PERIOD
        time.sleep(max(0.0, next_step - time.monotonic()))
    return pilot.end_episode(reward, truncated=True, executed_action=executed).result(timeout=60)


def main():
    server = sys.argv[1] if len(sys.argv) > 1 else "127.0.0.1:50051"
    robot = gymnasium.make("Pendulum-v1")
    options = spikeserve.SessionOptions(labels={"robot": "example"})  # the status page shows them
    with spikeserve.Client(server) as client, spikeserve.Pilot(client, "pendulum", PERIOD, session=options) as pilot:
        summary = fly(pilot, robot, seed=1_000_000)
        stats = pilot.stats()
    print(f"return {summary.episode_return:.0f} in {summary.steps} steps")
    print(f"{stats.fresh} answers in time, {stats.held} actions held, {stats.local} of a local engine, {stats.safe} safe")


if __name__ == "__main__":
    main()
