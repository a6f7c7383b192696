"""Compares fleets whose rewards come late with fleets whose rewards come in time, while the servers are killed.

usage: python -m tests.chaos.verdicts [--episodes=N] [--heads=N] [--latest=SECONDS] [--lag=ROUNDS] [--kills=N] [--seed=N]

Three servers share a Redis. Two fleets of four robots play the same episodes on two policies of equal weights. One fleet sends its
rewards with the ends; the other gets them as verdicts in the same order, 1 to --latest seconds after the ends (half of them within
2 s), each twice. Servers are killed during these calls. Nothing is played between an end and its verdict: each verdict is answered
as the end in time was, refusals and rollbacks of the guard included, and the heads are equal, bit for bit, or the exit status is
1. There are --heads such pairs, because one would wait for a day. With a lag the verdicts come --lag rounds later, and the decisions
of these rounds are made with an older head; the difference is printed. A round takes at least half a second, because of the limit
for one contributor. Needs the variable SPIKESERVE_PROGRAM.
"""

import argparse
import concurrent.futures
import contextlib
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
from serving import SHIPPED_POLICIES

PATIENCE = 1200.0  # seconds for servers that wait for a processor
PATIENT = spikeserve.ClientOptions(connect_timeout=PATIENCE, retry=spikeserve.RetryOptions(max_elapsed=PATIENCE))
ROBOTS = 4  # with five, some would be held out
STEPS = 3
MOMENTS = 3  # of a round, at which a replica may be killed
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
        self.counts = (0, 0, 0)  # updates since the last rollback, refusals, rollbacks: what the answers say

    def end(self, rewards):
        """Returns what the head has made of the episodes; None: they wait for their verdicts."""
        ends = [session.end_episode(r, terminated=True) for session, r in zip(self.sessions, rewards, strict=True)]
        return [self.count(ended.learning) for ended in ends]

    def judge(self, number, rewards):
        """Sends each verdict twice, as a judge that was restarted would. Returns what the head has made of the episodes."""
        learned = []
        for session, reward in zip(self.sessions, rewards, strict=True):
            answers = [self.client.amend_episode(session.session_id, number, "judge", reward=reward) for _ in range(2)]
            assert answers[0] == answers[1] and answers[0].episode_return == reward, answers
            learned.append(self.count(answers[0].learning))
        return learned

    def count(self, learning):
        if learning is not None:
            updates, rejected, rollbacks = self.counts
            updates = 0 if learning.rolled_back else updates + learning.updates
            self.counts = updates, rejected + learning.rejected_updates, rollbacks + learning.rolled_back
        return learning

    def head(self, admin):
        head = admin.get_head(policy=self.policy, version=1, include_weights=True)
        return np.array(head.delta), (head.updates, head.rejected_updates, head.rollbacks)

    def settle(self, admins):
        """Waits until all replicas decide with the head that has taken all episodes, as those of one server would."""
        deadline = time.monotonic() + PATIENCE
        for admin in admins:
            while (found := self.head_at(admin)) != self.counts:
                assert time.monotonic() < deadline, f"{self.policy}: expected {self.counts}, received {found}"
                time.sleep(0.1)  # servers read the log that often

    def head_at(self, admin):
        try:
            return self.head(admin)[1]
        except spikeserve.SpikeserveError:  # a busy machine
            return None


class Killer:
    """Kills a replica at some of the moments of the rounds, and starts the one before it again. Thread-safe."""

    def __init__(self, replicas, rounds, kills, seed):
        self.replicas, self.chance, self.killed = replicas, random.Random(seed), None
        self.admins = {replica: spikeserve.AdminClient(replica.address, PATIENT) for replica in replicas}
        moments = MOMENTS * rounds
        self.moments, self.moment = set(self.chance.sample(range(moments), min(kills, moments))), 0
        self.rounds = rounds  # that are left
        self.blow = threading.Thread()
        self.blow.start()
        self.changed = threading.Condition()
        self.players, self.is_starting = 0, False

    def take_round(self):
        """Returns whether another round is to be played."""
        with self.changed:
            self.rounds -= 1
            return self.rounds >= 0

    @contextlib.contextmanager
    def ending(self):
        """Lets nobody play on after a failure."""
        try:
            yield
        except BaseException:
            with self.changed:
                self.rounds = 0
            raise

    @contextlib.contextmanager
    def playing(self):
        """Keeps a killed replica, whose heads would have to settle first, from starting. Yields the operators of the others."""
        with self.changed:
            self.changed.wait_for(lambda: not self.is_starting)
            self.blow.join()
            self.players += 1
            admins = [self.admins[replica] for replica in self.replicas if replica is not self.killed]
        try:
            yield admins
        finally:
            with self.changed:
                self.players -= 1
                self.changed.notify_all()

    def strike(self):
        """Kills during the calls that follow, if it is the moment."""
        with self.changed:
            self.moment += 1
            if self.moment - 1 not in self.moments:
                return
            self.is_starting = True
            self.changed.wait_for(lambda: self.players == 0)
            self.blow.join()
            running = [replica for replica in self.replicas if replica is not self.killed]
            if self.killed is not None:
                self.killed.start()
            self.killed = self.chance.choice(running)
            self.blow = threading.Timer(self.chance.uniform(0.0, 0.02), self.killed.kill)
            self.blow.start()
            self.is_starting = False
            self.changed.notify_all()


class Pair:
    """Two fleets that play the same episodes, of which one gets its rewards late."""

    def __init__(self, client, number):
        self.client, self.number = client, number
        self.timely = FleetOfRobots(client, f"timely-{number}")
        self.late = FleetOfRobots(client, f"late-{number}", verdict_seconds=3600.0)
        self.ended = []  # when the episodes of each round ended
        self.learned = []  # what the timely fleet's head has made of them
        self.judged = 0  # rounds

    def rewards(self, number):
        return np.random.default_rng((7, self.number, number)).uniform(-1.0, 1.0, ROBOTS).tolist()

    def play(self, killer):
        number = len(self.ended)
        both = self.timely.sessions + self.late.sessions
        with killer.playing() as admins:
            self.timely.settle(admins)
            self.late.settle(admins)
            for t in range(STEPS):
                noise = np.random.default_rng((self.number, number, t)).uniform(-0.2, 0.2, (ROBOTS, 4))
                for decision in self.client.act_batch(both, np.concatenate([noise, noise]), [0.0] * len(both)):
                    assert decision.step == t, decision
        killer.strike()
        self.learned.append(self.timely.end(self.rewards(number)))
        killer.strike()
        assert self.late.end([0.0] * ROBOTS) == [None] * ROBOTS
        self.ended.append(time.monotonic())

    def judge(self, killer, lag):
        """Returns how many seconds late the verdicts of the next round are."""
        killer.strike()
        seconds = time.monotonic() - self.ended[self.judged]
        learned = self.late.judge(self.judged, self.rewards(self.judged))
        assert lag > 0 or learned == self.learned[self.judged], (self.number, learned, self.learned[self.judged])
        self.judged += 1
        return seconds


def play(pair, killer, arguments):
    """Plays rounds while there are some left. Returns how many seconds late the verdicts were."""
    chance, late = random.Random(1000 * arguments.seed + pair.number), []
    with killer.ending():
        while killer.take_round():
            pair.play(killer)
            time.sleep(arguments.latest ** chance.random() ** 4 if arguments.latest else 0.0)
            if len(pair.ended) - pair.judged > arguments.lag:
                late.append(pair.judge(killer, arguments.lag))
            time.sleep(max(0.0, pair.ended[-1] + ROUND_SECONDS - time.monotonic()))
        return late + [pair.judge(killer, arguments.lag) for _ in range(len(pair.ended) - pair.judged)]


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
            killer = Killer(fleet.replicas, arguments.episodes // ROBOTS, arguments.kills, arguments.seed)
            pairs = [Pair(client, number) for number in range(arguments.heads)]
            with concurrent.futures.ThreadPoolExecutor(len(pairs)) as threads:
                waits = threads.map(lambda pair: play(pair, killer, arguments), pairs)
                late = list(itertools.chain.from_iterable(waits))
            with killer.playing() as admins:
                heads = [(pair.timely.head(admins[0]), pair.late.head(admins[0])) for pair in pairs]
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
