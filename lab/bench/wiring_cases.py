"""Plays shipped policies on robots that are wired wrong, and prints how often the server says so, and what.

    spikeserve --policies=deploy/policies &
    python lab/bench/wiring_cases.py
    PYTHONPATH=examples python lab/bench/wiring_cases.py --policies=cart=own_environment:Cart-v0

Every exchange of two elements and every sign is a case, in three tables: the cases, their sums, and robots that are wired
right: `clean`, with 1.5 times the noise of the start, and with another mass, force or wind. A case matters if it changes
the return by more than 5 %. Within 50 steps, `verdicts` counts the starts with one, and `right` those whose last verdict
names the cause. `refused` says whether the server refuses the exchanged names.
"""

import argparse
import itertools
import statistics
from dataclasses import dataclass, field

import gymnasium
import numpy as np
import spikeserve
from gymnasium.envs.box2d import lunar_lander
from spikeserve.wire import METHODS

WINDOW = 50  # steps within which a verdict is to come
LONGEST = 1000
ROWS = 50  # robots that play together
TASKS = {
    "cartpole": "CartPole-v1",
    "pendulum": "Pendulum-v1",
    "acrobot": "Acrobot-v1",
    "mountaincar": "MountainCar-v0",
    "lunar-lander": "LunarLander-v3",
    "hopper": "Hopper-v5",
}
# The range of the start, 1.5 times as wide as that of the task.
NOISE = {
    "cartpole": {"low": -0.075, "high": 0.075},
    "pendulum": {"x_init": np.pi, "y_init": 1.5},
    "acrobot": {"low": -0.15, "high": 0.15},
    "mountaincar": {"low": -0.65, "high": -0.35},
}


@dataclass
class Robot:
    """One episode."""

    environment: gymnasium.Env
    observation: np.ndarray
    session: str
    reward: float = 0.0
    total: float = 0.0
    steps: int = 0
    over: bool = False
    causes: list = field(default_factory=list)  # (step, cause, elements) of each answer with a verdict

    def take(self, response):
        """Executes the action of an answer."""
        if response.HasField("wiring"):
            verdict = spikeserve.WiringVerdict.from_wire(response.wiring)
            self.causes.append((self.steps, verdict.cause, verdict.elements))
        action = response.action
        is_box = isinstance(self.environment.action_space, gymnasium.spaces.Box)
        executed = np.array(action.continuous.values, np.float32) if is_box else action.discrete
        self.observation, reward, terminated, truncated, _ = self.environment.step(executed)
        self.reward = float(reward)
        self.total += self.reward
        self.steps += 1
        self.over = terminated or truncated

    def last(self):
        """Returns the verdict after the window; None if there is none then."""
        within = [cause for cause in self.causes if cause[0] <= WINDOW]
        ended = min(self.steps - 1, WINDOW)
        return within[-1] if within and within[-1][0] == ended else None


def make(policy, kind):
    """Returns an environment: as trained, or with another world."""
    options = {}
    if kind == "physics" and policy == "lunar-lander":
        options = {"enable_wind": True, "wind_power": 10.0, "turbulence_power": 1.0}
    if kind == "noise" and policy == "hopper":
        options = {"reset_noise_scale": 7.5e-3}
    environment = gymnasium.make(TASKS[policy], **options)
    inner = environment.unwrapped
    if kind == "noise" and hasattr(inner, "reach"):
        inner.reach *= 1.5
    if kind == "physics":
        environment.reset(seed=0)
        for name, value in (("force_mag", 7.0), ("LINK_MASS_1", 1.3), ("m", 1.2), ("force", 0.0012), ("motor", 0.14)):
            if hasattr(inner, name):
                setattr(inner, name, value)
        if hasattr(inner, "model"):
            inner.model.body_mass[:] *= 1.2
    return environment


def play(client, policy, environments, seeds, wire=lambda x: x, most=LONGEST, kind="clean"):
    """Plays an episode in each environment, and returns the robots."""
    lunar_lander.INITIAL_RANDOM = 1500.0 if kind == "noise" else 1000.0
    options = NOISE.get(policy) if kind == "noise" else None
    robots = []
    for environment, seed in zip(environments, seeds):
        session = client.open_session(policy).session_id
        robots.append(Robot(environment, environment.reset(seed=seed, options=options)[0], session))
    for step in range(most):
        acting = [robot for robot in robots if not robot.over]
        if not acting:
            break
        requests = [
            {"session_id": robot.session, "step": step, "observation": wire(robot.observation), "reward": robot.reward}
            for robot in acting
        ]
        results = client.call("ActBatch", METHODS["ActBatch"].request(requests=requests)).results
        for robot, result in zip(acting, results):
            robot.take(result.response)
    for robot in robots:
        client.call("CloseSession", METHODS["CloseSession"].request(session_id=robot.session))
    return robots


def cases(size):
    """Yields name, cause, elements and wire of each case."""
    for i, j in itertools.combinations(range(size), 2):
        order = np.arange(size)
        order[[i, j]] = j, i
        yield f"{i} and {j} exchanged", "EXCHANGED", (i, j), lambda x, order=order: x[order]
    for i in range(size):
        signs = np.where(np.arange(size) == i, -1.0, 1.0)
        yield f"sign of {i}", "SIGN", (i,), lambda x, signs=signs: x * signs


def is_refused(client, policy, names, wire):
    """Returns whether the server refuses the names in the order of the case."""
    request = METHODS["OpenSession"].request(policy=policy, observation_names=wire(np.array(names)))
    try:
        client.call("OpenSession", request)
    except spikeserve.InvalidArgumentError:
        return True
    return False


def case_rows(client, policy, environments, arguments):
    """Prints a row for each case, and returns starts, verdicts and right causes of those that matter."""
    size = environments[0].observation_space.shape[0]
    served = next(each for each in reversed(client.list_policies()) if each.name == policy)
    names = [feature.name for feature in served.observation_features]
    base = statistics.mean(r.total for r in play(client, policy, environments[: arguments.returns], range(100)))
    sums = np.zeros(3, int)
    for name, cause, elements, wire in cases(size):
        whole = play(client, policy, environments[: arguments.returns], range(100, 200), wire)
        mean = statistics.mean(robot.total for robot in whole)
        matters = abs(mean - base) > 0.05 * abs(base)
        played = []
        for first in range(0, arguments.starts, ROWS):
            seeds = range(arguments.seed + first, arguments.seed + min(first + ROWS, arguments.starts))
            played += play(client, policy, environments, seeds, wire, WINDOW + 1)
        seen = sum(any(step <= WINDOW for step, *_ in robot.causes) for robot in played)
        right = sum(robot.last() is not None and robot.last()[1:] == (cause, elements) for robot in played)
        sums += np.array([len(played), seen, right]) * matters
        refused = "yes" if cause == "EXCHANGED" and is_refused(client, policy, names, wire) else "-"
        print(f"| {policy} | {name} | {refused} | {mean:.1f} | {'yes' if matters else 'no'} | {seen} | {right} |", flush=True)
    return sums


def right_row(client, policy, kind, arguments):
    """Returns a row about robots that are wired right."""
    environments = [make(policy, kind) for _ in range(ROWS)]
    robots, seed = [], arguments.seed + 10_000
    while sum(robot.steps for robot in robots) < arguments.steps:
        robots += play(client, policy, environments, range(seed, seed + ROWS), kind=kind)
        seed += ROWS
    named = [{cause for _, cause, _ in robot.causes} for robot in robots]
    wirings = sum(bool(causes - {"DYNAMICS"}) for causes in named)
    mean = statistics.mean(robot.total for robot in robots)
    steps = sum(robot.steps for robot in robots)
    return f"| {policy} | {kind} | {mean:.1f} | {len(robots)} | {steps:,} | {wirings} | {sum(map(bool, named))} |"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--server", default="127.0.0.1:50051")
    parser.add_argument("--policies", default=",".join(TASKS), help="NAME, or NAME=ENVIRONMENT for one of your own")
    parser.add_argument("--starts", type=int, default=100, help="of each case")
    parser.add_argument("--returns", type=int, default=10, help="whole episodes of each case")
    parser.add_argument("--steps", type=int, default=100_000, help="of the robots that are wired right")
    parser.add_argument("--seed", type=int, default=500_000)
    arguments = parser.parse_args()
    TASKS.update(each.split("=") for each in arguments.policies.split(",") if "=" in each)
    policies = [each.partition("=")[0] for each in arguments.policies.split(",")]
    print("| policy | case | refused | return | matters | verdicts | right |\n| --- | --- | --- | ---: | --- | ---: | ---: |")
    with spikeserve.Client(arguments.server) as client:
        made = {policy: [make(policy, "clean") for _ in range(ROWS)] for policy in policies}
        sums = {policy: case_rows(client, policy, made[policy], arguments) for policy in policies}
        print("\n| policy | starts that matter | verdicts | right |\n| --- | ---: | ---: | ---: |")
        for policy, (starts, seen, right) in sums.items():
            print(f"| {policy} | {starts} | {100 * seen / max(starts, 1):.1f} % | {100 * right / max(starts, 1):.1f} % |")
        print("\n| policy | world | return | episodes | steps | with a wiring named | with a verdict |")
        print("| --- | --- | ---: | ---: | ---: | ---: | ---: |")
        for policy, kind in itertools.product(policies, ("clean", "noise", "physics")):
            print(right_row(client, policy, kind, arguments), flush=True)


if __name__ == "__main__":
    main()
