"""Compares fleets whose rewards come late with fleets whose rewards come in time, while the servers are killed.

usage: python -m tests.chaos.verdicts [--episodes=N] [--heads=N] [--latest=SECONDS] [--lag=ROUNDS] [--kills=N] [--seed=N]

Three servers share a Redis. Two fleets of four robots play the same episodes on two policies of equal weights. One fleet sends its
rewards with the ends; the other gets them as verdicts in the same order, 1 to --latest seconds after the ends (half of them within
3 s), each twice. Servers are killed during these calls. Nothing is played between an end and its verdict: the heads are equal, bit
for bit, or the exit status is 1. There are --heads such pairs, because one would wait for a day. With a lag the verdicts come
--lag rounds later, and the decisions of these rounds are made with an older head; the difference is printed. A round takes at
least half a second, because of the limit for one contributor. Needs the variable SPIKESERVE_PROGRAM.
"""

import argparse
import heapq
import itertools
import pathlib
import random
import shutil
import statistics
import sys
import tempfile
import threading
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
WINDOW = 20  # episodes that the guard judges together; it may begin to count anew behind them
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
        for t in range(STEPS):
            noise = np.random.default_rng((number, t)).uniform(-0.2, 0.2, (ROBOTS, 4))
            for decision in self.client.act_batch(self.sessions, noise, [0.0] * ROBOTS):
                assert decision.step == t, decision

    def end(self, rewards):
        for session, reward in zip(self.sessions, rewards, strict=True):
            session.end_episode(reward, terminated=True)

    def judge(self, number, rewards):
        """Sends each verdict twice, as a judge that was restarted would."""
        for session, reward in zip(self.sessions, rewards, strict=True):
            answers = [self.client.amend_episode(session.session_id, number, "judge", reward=reward) for _ in range(2)]
            assert answers[0] == answers[1] and answers[0].learning.updates == 1, answers

    def head(self, admin):
        head = admin.get_head(policy=self.policy, version=1, include_weights=True)
        return np.array(head.delta), (head.updates, head.rejected_updates, head.rollbacks)

    def settle(self, admins, rounds):
        """Waits until all replicas decide with the head of the contributions of so many rounds, as those of one server would."""

        def is_settled():
            heads = [admin.get_head(policy=self.policy, version=1) for admin in admins]
            same = all(h.delta_norm == heads[0].delta_norm and h.rollbacks == heads[0].rollbacks for h in heads)
            return same and all((h.updates - rounds * ROBOTS) % WINDOW == 0 for h in heads)

        until(is_settled)


class Killer:
    """Kills a replica at some of so many moments, and starts the one before it again."""

    def __init__(self, replicas, moments, kills, seed):
        self.replicas, self.chance, self.killed = replicas, random.Random(seed), None
        self.admins = {replica: spikeserve.AdminClient(replica.address, PATIENT) for replica in replicas}
        self.moments, self.moment = set(self.chance.sample(range(moments), min(kills, moments))), 0
        self.blow = threading.Thread()
        self.blow.start()

    def running(self):
        self.blow.join()
        return [replica for replica in self.replicas if replica is not self.killed]

    def strike(self):
        """Kills during the calls that follow, if it is the moment."""
        self.moment += 1
        if self.moment - 1 not in self.moments:
            return
        running = self.running()
        if self.killed is not None:
            self.killed.start()
        self.killed = self.chance.choice(running)
        self.blow = threading.Timer(self.chance.uniform(0.0, 0.02), self.killed.kill)
        self.blow.start()


class Pair:
    """Two fleets that play the same episodes, of which one gets its rewards late."""

    def __init__(self, client, number):
        self.number = number
        self.timely = FleetOfRobots(client, f"timely-{number}")
        self.late = FleetOfRobots(client, f"late-{number}", verdict_seconds=3600.0)
        self.ended = []  # when the episodes of each round ended
        self.judged = 0  # rounds

    def rewards(self, number):
        return np.random.default_rng((7, self.number, number)).uniform(-1.0, 1.0, ROBOTS).tolist()

    def play(self, killer):
        number = len(self.ended)
        admins = [killer.admins[replica] for replica in killer.running()]
        self.timely.settle(admins, number)
        self.late.settle(admins, self.judged)
        for robots in (self.timely, self.late):
            robots.play(number)
        killer.strike()
        self.timely.end(self.rewards(number))
        killer.strike()
        self.late.end([0.0] * ROBOTS)
        self.ended.append(time.monotonic())

    def judge(self, killer):
        """Returns how many seconds late the verdicts of the next round are."""
        killer.strike()
        seconds = time.monotonic() - self.ended[self.judged]
        self.late.judge(self.judged, self.rewards(self.judged))
        self.judged += 1
        return seconds


def play(pairs, killer, arguments):
    """Plays all rounds. Returns how many seconds late the verdicts were."""
    chance, late = random.Random(arguments.seed), []
    left = arguments.episodes // ROBOTS
    order = itertools.count()  # of what is due at one time
    due = [(0.0, next(order), pair, Pair.play) for pair in pairs]
    while due:
        at, _, pair, work = heapq.heappop(due)
        time.sleep(max(0.0, at - time.monotonic()))
        if work is Pair.play and left == 0:
            late += [pair.judge(killer) for _ in range(len(pair.ended) - pair.judged)]
            continue
        if work is Pair.judge:
            if len(pair.ended) - pair.judged > arguments.lag:
                late.append(pair.judge(killer))
            heapq.heappush(due, (pair.ended[-1] + ROUND_SECONDS, next(order), pair, Pair.play))
        else:
            left -= 1
            pair.play(killer)
            wait = arguments.latest ** chance.random() ** 3 if arguments.latest else 0.0
            heapq.heappush(due, (pair.ended[-1] + wait, next(order), pair, Pair.judge))
    return late


def main():
    parser = argparse.ArgumentParser(prog="tests.chaos.verdicts")
    parser.add_argument("--episodes", type=int, default=10_000, help="of the fleets of each kind")
    parser.add_argument("--heads", type=int, default=40, help="of each kind")
    parser.add_argument(
        "--latest", type=float, default=600.0, help="seconds between an end and its verdict; 0: at once"
    )
    parser.add_argument("--lag", type=int, default=0, help="rounds between an end and its verdict")
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1, help="of the kills")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(arguments.heads):
            for kind in ("timely", "late"):
                shutil.copytree(SHIPPED_POLICIES / "cartpole-small/1", pathlib.Path(folder) / f"{kind}-{number}" / "1")
        with (
            running_fleet(f"--policies={folder}") as fleet,
            spikeserve.Client(fleet.addresses, PATIENT) as client,
        ):
            killer = Killer(fleet.replicas, arguments.episodes // ROBOTS * 3, arguments.kills, arguments.seed)
            pairs = [Pair(client, number) for number in range(arguments.heads)]
            late = play(pairs, killer, arguments)
            admin = killer.admins[killer.running()[0]]
            heads = [(pair.timely.head(admin), pair.late.head(admin)) for pair in pairs]
    print(f"{arguments.episodes} episodes of {arguments.heads} fleets of each kind, {arguments.kills} kills")
    print(f"verdicts {min(late):.2f} to {max(late):.2f} s late, median {statistics.median(late):.2f} s")
    counts = [[head[1] for head in heads_of] for heads_of in zip(*heads, strict=True)]
    for name, of_kind in zip(("in time", "late"), counts, strict=True):
        print(f"{name}: updates since the last rollback, rejected, rollbacks: {np.sum(of_kind, axis=0).tolist()}")
    differences = [np.linalg.norm(t[0] - l[0]) / np.linalg.norm(t[0]) for t, l in heads if t[0].any()]
    equal = sum(np.array_equal(t[0], l[0]) and t[1] == l[1] for t, l in heads)
    print(
        f"{equal} of {len(heads)} heads are equal; they differ by {max(differences):.3g} of the norm of what was learned"
    )
    return 0 if arguments.lag > 0 or equal == len(heads) else 1


if __name__ == "__main__":
    sys.exit(main())
