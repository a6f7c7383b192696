#!/usr/bin/env python3
"""Plays fleets of 16 in which an operator corrects one robot: a good one, or one who spoils it.

usage: lab/bench/corrected_fleets.py [--seeds=10] [EXPERIMENT...]

Needs spikeserve_engine, whose sessions learn as the server's do, bit for bit. EXPERIMENT is `good` (corrections.py's operators
on reversed motors), or `opposite` or `random` (on the task that the policy was trained for). In each round the operator takes the
first CORRECTED steps of an episode of one robot, while the 15 others play alone; a robot whose episode is refused, because it is
held out, is exchanged for the next. After ROUNDS that were taken, the fleet plays REST rounds without him. Prints what a frozen
session with the fleet's head returns from starts that nobody has seen.
"""

import argparse
import statistics
import sys

import numpy as np
from corrections import TASKS, mean_return, play, shipped
from spikeserve_engine import Learning

ROBOTS = 16
CORRECTED = 50  # steps of an episode
ROUNDS = (2, 10, 20)
ADDED = 2  # rounds after which the head has what was gathered in its first window
REST = 6  # rounds: four windows of the guard


EXPERIMENTS = {
    "good": ("ReversedCartPole", "ReversedPendulum"),
    "opposite": ("OppositeCartPole", "OppositePendulum"),
    "random": ("RandomCartPole", "RandomPendulum"),
}


class Fleet:
    """16 sessions that share a head, one of which is corrected."""

    def __init__(self, task, seed):
        self.task, self.seed, self.rounds, self.chosen = task, seed, 0, 0
        self.engine = shipped(task.policy)  # with a shared head of its own
        self.robots = [self.engine.session(learning=Learning(rule="corrections", scope="FLEET")) for _ in range(ROBOTS)]

    def round(self, corrects=0):
        """Plays an episode of each robot. Returns whether the head took a corrected one."""
        taken, chosen = False, self.chosen
        for number, robot in enumerate(self.robots):
            start = 1000 * self.seed + ROBOTS * self.rounds + number
            _, steps, summary = play(self.task, self.engine, robot, start, corrects if number == chosen else 0)
            if steps > 0 and summary.learning.rejected_updates > 0:
                self.chosen = (chosen + 1) % ROBOTS
            elif steps > 0:
                taken = True
        self.rounds += 1
        return taken

    def teach(self, rounds):
        while rounds > 0:
            rounds -= self.round(CORRECTED)
        for _ in range(ADDED):
            self.round()

    def head(self):
        return np.array(self.robots[0].state().head_delta)

    def returns(self, starts):
        return mean_return(self.task, self.engine, starts, self.head())


def measure(task, seed, starts):
    """Returns the return of the head after each of ROUNDS, and after the fleet was left alone."""
    fleet, corrected, after = Fleet(task, seed), 0, []
    for rounds in ROUNDS:
        fleet.teach(rounds - corrected)
        corrected = rounds
        after.append(fleet.returns(starts))
    for _ in range(REST):
        fleet.round()
    state = fleet.robots[0].state()
    return *after, fleet.returns(starts), state.head_drift, state.rollbacks


def main():
    parser = argparse.ArgumentParser(prog="lab/bench/corrected_fleets.py")
    parser.add_argument("experiments", nargs="*", default=list(EXPERIMENTS), metavar="EXPERIMENT")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--starts", type=int, default=20, help="unseen ones of each evaluation")
    arguments = parser.parse_args()
    heads = [f"after {rounds} episodes" for rounds in ROUNDS] + [f"{REST} rounds later", "drift", "rollbacks"]
    print(f"| operator | task | the policy | {' | '.join(heads)} |")
    print("| --- | --- | ---: | " + " | ".join(["---"] * len(heads)) + " |")
    for name in arguments.experiments:
        for kind in EXPERIMENTS[name]:
            task = TASKS[kind]()
            frozen = mean_return(task, shipped(task.policy), arguments.starts)
            runs = [measure(task, seed, arguments.starts) for seed in range(1, arguments.seeds + 1)]
            cells = []
            for values in map(sorted, zip(*runs)):
                cells.append(f"{statistics.median(values):.4g} ({values[0]:.4g} to {values[-1]:.4g})")
            print(f"| {name} | {kind} | {frozen:.1f} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
