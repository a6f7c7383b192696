"""A robot that plays Pendulum with openpi-client, which waits for each answer: openpi_robot.py ADDRESS RATE SECONDS.

Runs in the Python of openpi-client. Prints "playing" and at the end the figures of robots.cc. The beats that pass while
the client waits have no action: the motor holds the last one. A broken connection is replaced.
"""

import json
import os
import signal
import sys
import time

import gymnasium
import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy

ADDRESS, RATE, SECONDS = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
PERIOD, MAX_AGE, EPISODE = 1 / RATE, 0.25, 200


class World:
    """Pendulum, which goes on with the last action while the robot waits."""

    def __init__(self):
        self._environment = gymnasium.make("Pendulum-v1", max_episode_steps=EPISODE)
        self.returns, self._total = [], 0.0
        self._reset()

    def _reset(self):
        self.observation, _ = self._environment.reset(seed=len(self.returns))

    def step(self, action):
        self.observation, reward, _, over, _ = self._environment.step(action)
        self._total += float(reward)
        if over:
            self.returns.append(self._total)
            self._total = 0.0
            self._reset()


class TimeIsOver(BaseException):
    pass


def end(*_):
    raise TimeIsOver


class Robot:
    def __init__(self):
        self.world, self.policy = World(), WebsocketClientPolicy(ADDRESS)
        self.action = np.zeros(1, np.float32)
        self.ages, self.stale, self.longest = [], 0, 0.0
        self.due = self.fresh_at = time.monotonic()

    def beat(self):
        asked, last = time.monotonic(), self.action
        try:
            if self.policy is None:
                self.policy = WebsocketClientPolicy(ADDRESS)
            self.action = self.policy.infer({"observation": self.world.observation})["actions"][0]
        except Exception:
            self.policy = None
            time.sleep(PERIOD)
            return
        now = time.monotonic()
        self.ages.append(now - asked)
        self.stale += self.ages[-1] > MAX_AGE
        self.longest, self.fresh_at = max(self.longest, now - self.fresh_at), now
        passed = int((now - self.due) / PERIOD)  # beats
        for _ in range(passed):
            self.world.step(last)
        self.world.step(self.action)
        self.due = max(self.due + (1 + passed) * PERIOD, time.monotonic() - PERIOD)
        time.sleep(max(0.0, self.due - time.monotonic()))

    def figures(self):
        p50, p99, p999 = (float(np.quantile(self.ages, share)) for share in (0.5, 0.99, 0.999))
        beats, fresh = round(SECONDS * RATE), len(self.ages)
        returns = self.world.returns
        return {
            "beats": fresh,
            "fresh": fresh,
            "none": max(0, beats - fresh),
            "stale": self.stale,
            "longest": max(self.longest, time.monotonic() - self.fresh_at),
            "p50": p50,
            "p99": p99,
            "p999": p999,
            "return": float(np.mean(returns)) if returns else None,
        }


def main():
    robot = Robot()
    print("playing", flush=True)
    signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        while True:
            robot.beat()
    except TimeIsOver:
        print(json.dumps(robot.figures()), flush=True)
    os._exit(0)  # without waiting for the connection


main()
