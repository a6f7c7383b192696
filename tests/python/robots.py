"""A fleet of robots that play real Gymnasium tasks against a server until the end of a block."""

import threading
import time

import gymnasium
import numpy as np

EPISODE_STEPS = 200
PAUSE_SECONDS = 0.02  # between the decisions of a robot, so that a fleet leaves time to others


class Robot:
    """Plays one task. Opens a new session after each episode unless it keeps its session.

    `broken` is the probability that the motor does not follow the policy, by version of the policy.
    """

    def __init__(self, service, task, policy, name, broken, keeps_session, episode_steps, seed):
        self._service = service
        self._environment = gymnasium.make(task, max_episode_steps=episode_steps)
        self._policy = policy
        self._name = name
        self._broken = broken
        self._keeps_session = keeps_session
        self._random = np.random.default_rng(seed)
        self._seed = seed
        self.session = None
        self._open()

    def _open(self):
        opened = self._service.OpenSession(policy=self._policy, labels={"robot": self._name})
        self.session, self._version = opened.session_id, opened.version
        self._observation, _ = self._environment.reset(seed=self._seed)
        self._step, self._reward = 0, 0.0

    def act(self):
        answer = self._service.Act(
            session_id=self.session, step=self._step, observation=self._observation, reward=self._reward
        )
        space = self._environment.action_space
        if isinstance(space, gymnasium.spaces.Discrete):
            action = answer.action.discrete
        else:
            action = np.array(answer.action.continuous.values, np.float32)
        if self._random.random() < self._broken.get(self._version, self._broken.get(None, 0.0)):
            action = space.sample()
        self._observation, self._reward, terminated, truncated, _ = self._environment.step(action)
        self._reward = float(self._reward)
        self._step += 1
        if not (terminated or truncated):
            return
        self._service.EndEpisode(
            session_id=self.session, reward=self._reward, terminated=terminated, truncated=truncated
        )
        if self._keeps_session:
            self._observation, _ = self._environment.reset()
            self._step, self._reward = 0, 0.0
            return
        self._service.CloseSession(session_id=self.session)
        self._open()


class Fleet:
    """Robots of several tasks that act in turn, on a thread of their own."""

    def __init__(self, service):
        self._service = service
        self._robots = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._play)

    def add(self, task, policy, count, broken=None, keeps_session=True, episode_steps=EPISODE_STEPS, prefix="arm"):
        for _ in range(count):
            name = f"{prefix}-{len(self._robots):02}"
            self._robots[name] = Robot(
                self._service, task, policy, name, broken or {}, keeps_session, episode_steps, seed=len(self._robots)
            )

    def session_of(self, name):
        return self._robots[name].session

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()

    def _play(self):
        while not self._stop.is_set():
            began = time.monotonic()
            for robot in self._robots.values():
                robot.act()
            self._stop.wait(max(0.0, PAUSE_SECONDS - (time.monotonic() - began)))
