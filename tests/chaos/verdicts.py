"""Compares a fleet whose rewards come late with one whose rewards come in time, while the servers are killed.

usage: python -m tests.chaos.verdicts [--episodes=N] [--lag=ROUNDS] [--kills=N] [--seed=N]

Three servers share a Redis. Two fleets of four robots play the same episodes on two policies of equal weights. One fleet sends its
rewards with the ends; the other gets them as verdicts, --lag rounds later, in the same order. Without a lag nothing is played
between an end and its verdict: the heads are equal, bit for bit, or the exit status is 1. With a lag the decisions of these rounds
are made with an older head; the difference is printed. A round takes half a second, because of the limit for one contributor.
Needs the variable SPIKESERVE_PROGRAM.
"""

import argparse
import pathlib
import random
import shutil
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python")]

import numpy as np
import spikeserve
from replicated import running_fleet
from security import until
from serving import SHIPPED_POLICIES

PATIENT = spikeserve.ClientOptions(connect_timeout=60.0, retry=spikeserve.RetryOptions(max_elapsed=60.0))
ROBOTS = 4  # with five, some would be held out
STEPS = 5
ROUND_SECONDS = 0.55  # 120 contributions a minute are accepted of a session


class FleetOfRobots:
    """Four sessions that learn one head."""

    def __init__(self, client, policy, **learning):
        self.client, self.policy = client, policy
        learning = spikeserve.Learning(scope="FLEET", **learning)
        self.sessions = [
            client.open_session(
                policy, spikeserve.SessionOptions(seed=i, sample=True, temperature=4.0, learning=learning)
            )
            for i in range(ROBOTS)
        ]

    def play(self, number):
        for i, session in enumerate(self.sessions):
            for t in range(STEPS):
                noise = np.random.default_rng((number, i, t))
                session.act(noise.uniform(-0.2, 0.2, 4), 0.0)

    def end(self, rewards):
        for session, reward in zip(self.sessions, rewards, strict=True):
            session.end_episode(reward, terminated=True)

    def judge(self, number, rewards):
        """Sends each verdict twice, as a judge that was restarted would."""
        for session, reward in zip(self.sessions, rewards, strict=True):
            answers = [self.client.amend_episode(session.session_id, number, "judge", reward=reward) for _ in range(2)]
            assert answers[0] == answers[1] and answers[0].learning.updates == 1, answers

    def head(self, server):
        with spikeserve.AdminClient(server) as admin:
            head = admin.get_head(policy=self.policy, version=1, include_weights=True)
        return np.array(head.delta), (head.updates, head.rejected_updates, head.rollbacks)


class Killer:
    """Kills a replica before some of the rounds, and starts the one before it again."""

    def __init__(self, replicas, rounds, kills, seed):
        self.replicas, self.chance, self.killed = replicas, random.Random(seed), None
        self.rounds = set(self.chance.sample(range(rounds), min(kills, rounds)))

    def strike(self, number):
        if number not in self.rounds:
            return
        if self.killed is not None:
            self.killed.start()
        self.killed = self.chance.choice([replica for replica in self.replicas if replica is not self.killed])
        self.killed.kill()


def settle(replicas, number):
    """Waits until all replicas decide with the head of all `number` contributions, as those of one server would."""
    for replica in replicas:
        with spikeserve.AdminClient(replica.address, PATIENT) as admin:
            for policy, expected in number.items():
                until(lambda p=policy, e=expected, a=admin: a.get_head(policy=p, version=1).updates >= e)


def rewards_of(number):
    return np.random.default_rng((7, number)).uniform(-1.0, 1.0, ROBOTS).tolist()


def play(fleet, client, arguments):
    """Plays both fleets, and returns their heads and counts."""
    rounds = arguments.episodes // ROBOTS
    timely = FleetOfRobots(client, "timely")
    late = FleetOfRobots(client, "late", verdict_seconds=3600.0)
    killer = Killer(fleet.replicas, rounds, arguments.kills, arguments.seed)
    for number in range(rounds):
        begun = time.monotonic()
        judged = max(0, number - arguments.lag)
        running = [replica for replica in fleet.replicas if replica is not killer.killed]
        settle(running, {"timely": number * ROBOTS, "late": judged * ROBOTS})
        for robots in (timely, late):
            robots.play(number)
        timely.end(rewards_of(number))
        late.end([0.0] * ROBOTS)
        killer.strike(number)
        if number >= arguments.lag:
            late.judge(number - arguments.lag, rewards_of(number - arguments.lag))
        time.sleep(max(0.0, begun + ROUND_SECONDS - time.monotonic()))
    for number in range(max(0, rounds - arguments.lag), rounds):
        late.judge(number, rewards_of(number))
    server = next(replica for replica in fleet.replicas if replica is not killer.killed)
    return timely.head(server.address), late.head(server.address)


def main():
    parser = argparse.ArgumentParser(prog="tests.chaos.verdicts")
    parser.add_argument("--episodes", type=int, default=10_000, help="of each fleet")
    parser.add_argument("--lag", type=int, default=0, help="rounds between an end and its verdict")
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1, help="of the kills")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for policy in ("timely", "late"):
            shutil.copytree(SHIPPED_POLICIES / "cartpole/1", pathlib.Path(folder) / policy / "1")
        with (
            running_fleet(f"--policies={folder}") as fleet,
            spikeserve.Client(fleet.addresses, PATIENT) as client,
        ):
            (timely, counts), (late, late_counts) = play(fleet, client, arguments)
    difference = np.linalg.norm(timely - late) / np.linalg.norm(timely)
    print(f"{arguments.episodes} episodes a fleet, {arguments.kills} kills, verdicts {arguments.lag} rounds late")
    print(f"updates, rejected, rollbacks: {counts} in time, {late_counts} late")
    print(f"the heads differ by {difference:.3g} of the norm of what was learned")
    same = counts == late_counts and (arguments.lag > 0 or np.array_equal(timely, late))
    return 0 if same and timely.any() else 1


if __name__ == "__main__":
    sys.exit(main())
