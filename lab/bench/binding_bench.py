"""Compares the decisions of the Python engine in batches with those of engine_bench, which is without Python.

Both decide for the same number of agents at once, on random observations. They are measured in turn, in processor time.
The ratio is the median of the ratios of the rounds.

    PYTHONPATH=build/release/python build/venv/bin/python lab/bench/binding_bench.py --bin=build/release/bin
"""

import argparse
import pathlib
import statistics
import sys

import contestant
import numpy as np
import programs
from server_bench import SHIPPED

BOUND = 0.05  # of the random observations
EPISODE_STEPS = 500


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="folder of engine_bench")
    parser.add_argument("--policy", type=pathlib.Path, default=SHIPPED, help="policy for CartPole-v1")
    parser.add_argument("--together", type=int, default=64, help="agents that decide together")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=0.5, help="seconds for each contestant in a round")
    parser.add_argument("--contestant", action="store_true", help="be the Python contestant")
    return parser.parse_args()


def play(policy, together):
    """Is the contestant: makes batches of decisions with the Python engine. Counts batches."""
    import spikeserve_engine

    engine = spikeserve_engine.Engine(policy)
    generator = np.random.default_rng(0)
    observations = generator.uniform(-BOUND, BOUND, (EPISODE_STEPS, together, 4)).astype(np.float32)
    sessions = [engine.session() for _ in range(together)]
    rewards = np.ones(together)
    step = 0

    def decide():
        nonlocal step
        if step == EPISODE_STEPS:
            for session in sessions:
                session.end_episode(1.0, truncated=True)
            step = 0
        engine.act_batch(sessions, observations[step], rewards)
        step += 1

    contestant.run(decide)


def main():
    arguments = parse_arguments()
    if arguments.contestant:
        play(arguments.policy, arguments.together)
        return
    shared = [f"--policy={arguments.policy}", f"--together={arguments.together}"]
    bounds = [f"--observation_bound={BOUND}", f"--episode_steps={EPISODE_STEPS}"]
    commands = {
        "engine_bench": [arguments.bin / "engine_bench", *shared, *bounds],
        "python": [sys.executable, __file__, f"--bin={arguments.bin}", *shared, "--contestant"],
    }
    rates = {name: [] for name in commands}
    with programs.running_contestants(commands) as contestants:
        for round_ in range(arguments.rounds + 1):
            for player in contestants:
                measured = player.measure(arguments.seconds)
                batch = arguments.together if player.name == "python" else 1
                if round_ > 0:  # the first one warms up caches and clock frequency
                    rates[player.name].append(batch * measured["decisions"] / measured["seconds"])
    ratios = [python / plain for python, plain in zip(rates["python"], rates["engine_bench"])]
    for name, values in rates.items():
        print(f"{name}: {statistics.median(values):,.0f} decisions a second")
    print(f"ratio: {statistics.median(ratios):.3f} ({min(ratios):.3f} to {max(ratios):.3f})")


if __name__ == "__main__":
    main()
