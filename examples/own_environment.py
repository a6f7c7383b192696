"""Trains a policy for an environment of your own from an expert, serves it and plays it, in a few minutes on one core.

usage: python examples/own_environment.py FOLDER

Needs pip install ./client/python/engine ./client/python "./train/python[imitation]", and the programs of `make build` in PATH.
"""

import subprocess
import sys

import gymnasium
import numpy as np
import spikeserve
from spikeserve.imitation import ImitationOptions

# Small, so that this example is quick; the defaults take longer and come nearer to the expert.
QUICK = ImitationOptions(
    steps=4000, iterations=120, rounds=1, round_steps=1000, round_iterations=40, hidden_size=32, layers=1, silence=(),
    selection_episodes=8, episodes=8, train_flags=("--slope=4", "--heads=2"),
)  # fmt: skip


class Cart(gymnasium.Env):
    """A motor pushes a cart to a place. The observation is the position, the velocity and the place."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    reach, motor = 1.0, 0.2  # largest distance from the middle at the start; change of velocity in a step at full force

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.reach * np.array([self.np_random.uniform(-1, 1), 0.0, self.np_random.uniform(-1, 1)])
        return self.state.astype(np.float32), {}

    def step(self, force):
        self.state[1] += self.motor * np.clip(force[0], -1, 1)
        self.state[0] += 0.05 * self.state[1]
        return self.state.astype(np.float32), -abs(self.state[2] - self.state[0]), False, False, {}


gymnasium.register("Cart-v0", entry_point=Cart, max_episode_steps=100)


def expert(observation):
    position, velocity, place = observation
    return np.clip([3 * (place - position) - 1.5 * velocity], -1, 1)


def main(folder):
    result = spikeserve.imitate("Cart-v0", expert, folder, options=QUICK)
    print(f"expert {result.expert_figures.mean:.1f}, policy {result.figures.mean:.1f}")
    command = ["spikeserve", f"--policies={folder}/policies", "--listen=127.0.0.1:0", "--http_listen="]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        address = server.stdout.readline().split()[-1]  # spikeserve: serving gRPC on 127.0.0.1:PORT
        print(spikeserve.evaluate("Cart-v0", server=address, episodes=8))
        server.terminate()


if __name__ == "__main__":
    main(sys.argv[1])
