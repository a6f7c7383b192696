"""Plays shipped policies on robots that are wired wrong, and prints how often the server says so, and what.

    spikeserve --policies=deploy/policies &
    python lab/bench/wiring_cases.py --server=127.0.0.1:50051 --starts=100

Every exchange of two elements and every sign is a case. `matters`: the return differs from that of the right wiring by
more than 5 %. `clean` sessions are wired right; `noise` adds half of the task's own noise at the start again, and `physics`
changes the mass, the force or the wind.
"""

import argparse
import itertools
import statistics

import gymnasium
import numpy as np
import spikeserve

WINDOW = 50  # steps within which a verdict is to come
TASKS = {
    "cartpole": "CartPole-v1",
    "pendulum": "Pendulum-v1",
    "acrobot": "Acrobot-v1",
    "lunar-lander": "LunarLander-v3",
    "hopper": "Hopper-v5",
}


def lighter(environment):
    inner = environment.unwrapped
    if hasattr(inner, "masspole"):
        inner.force_mag *= 0.7
    elif hasattr(inner, "LINK_MASS_1"):
        inner.LINK_MASS_1 = 1.3
    elif hasattr(inner, "m"):
        inner.m *= 1.2
    elif hasattr(inner, "model"):
        inner.model.body_mass[:] *= 1.2


def make(policy, perturbed=False):
    options = {"enable_wind": True, "wind_power": 10.0} if perturbed and policy == "lunar-lander" else {}
    environment = gymnasium.make(TASKS[policy], **options)
    if perturbed:
        environment.reset(seed=0)
        lighter(environment)
    return environment


def play(client, policy, environment, wire, seed, most=1000, until_verdict=False, noise=0.0):
    """Plays an episode. Returns its return, its steps, and the first verdict and its last name within the window."""
    observation, _ = environment.reset(seed=seed)
    scale = np.random.default_rng(seed).normal(size=len(observation)) * noise
    total, reward, named, first, step = 0.0, 0.0, None, None, 0
    with client.open_session(policy) as session:
        for step in range(most):
            decision = session.act(wire(observation + scale), reward)
            if decision.wiring is not None:
                first = step if first is None else first
                if step <= WINDOW + 1:
                    named = decision.wiring
                if until_verdict:
                    break
            observation, reward, terminated, truncated, _ = environment.step(decision.action)
            total += reward
            if terminated or truncated:
                break
    return total, step + 1, first, named


def cases(size):
    for i, j in itertools.combinations(range(size), 2):
        order = list(range(size))
        order[i], order[j] = j, i
        yield f"{i} and {j} exchanged", "EXCHANGED", (i, j), lambda x, order=order: x[order]
    for i in range(size):
        signs = np.where(np.arange(size) == i, -1.0, 1.0)
        yield f"sign of {i}", "SIGN", (i,), lambda x, signs=signs: x * signs


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--server", default="127.0.0.1:50051")
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--policies", default=",".join(TASKS))
    arguments = parser.parse_args()
    print("| policy | case | return | matters | verdict within 50 steps | right cause |\n| --- | --- | ---: | --- | ---: | ---: |")
    summaries = []
    with spikeserve.Client(arguments.server) as client:
        for policy in arguments.policies.split(","):
            environment = make(policy)
            size = environment.observation_space.shape[0]
            seeds = range(9000, 9000 + arguments.starts)
            clean = [play(client, policy, environment, lambda x: x, seed) for seed in range(20)]
            base = statistics.mean(result[0] for result in clean)
            found = named = total = 0
            for name, cause, elements, wire in cases(size):
                whole = [play(client, policy, environment, wire, 500 + seed) for seed in range(5)]
                mean = statistics.mean(result[0] for result in whole)
                matters = abs(mean - base) > 0.05 * abs(base)
                played = [play(client, policy, environment, wire, seed, WINDOW + 2) for seed in seeds]
                seen = sum(result[2] is not None for result in played)
                right = sum(
                    result[3] is not None and (result[3].cause, result[3].elements) == (cause, elements)
                    for result in played
                )
                if matters:
                    found, named, total = found + seen, named + right, total + len(played)
                print(f"| {policy} | {name} | {mean:.1f} | {'yes' if matters else 'no'} | {seen} of {len(played)} | {right} |", flush=True)
            steps = sum(result[1] for result in clean)
            false = sum(result[2] is not None for result in clean)
            noisy = [play(client, policy, environment, lambda x: x, seed, noise=0.01) for seed in range(5)]
            other = make(policy, perturbed=True)
            perturbed = [play(client, policy, other, lambda x: x, seed) for seed in range(5)]
            wrong = sum(result[3] is not None and result[3].cause != "DYNAMICS" for result in perturbed)
            summaries.append(
                f"| {policy} | {100 * found / max(total, 1):.0f} % | {100 * named / max(total, 1):.0f} % | "
                f"{false} in {steps} steps | {sum(r[2] is not None for r in noisy)} of {len(noisy)} | {wrong} of {len(perturbed)} |"
            )
    print("\n| policy | verdicts | right causes | clean: verdicts | noise: verdicts | physics: wrong causes |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    print("\n".join(summaries))


if __name__ == "__main__":
    main()
