"""Counts the beats of a robot without a fresh action: a pilot, and a call per beat, over links with delay, loss and cuts.

    python loadtest/bench/beats_bench.py --server=build/release/bin/spikeserve --markdown

The link is a TCP route in a process of its own (tests/python/links.py): a lost segment holds back those behind it until
it is sent again, after 0.2 s or more. Prints one row for each case. Runs `--seconds` for each of them.
"""

import argparse
import contextlib
import json
import multiprocessing
import os
import pathlib
import sys
import time

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests" / "python")]

import gymnasium  # noqa: E402
import numpy as np  # noqa: E402
import spikeserve  # noqa: E402
from links import Link  # noqa: E402
from serving import SHIPPED_POLICIES, running_server  # noqa: E402

POLICY, TASK, PERIOD = "pendulum", "Pendulum-v1", 0.02
EPISODE = 200  # beats
# Round trip in seconds, share of lost segments, length of a cut in seconds, what happens to the connection.
CASES = [
    (0.0004, 0.0, 0, ""),
    (0.01, 0.0, 0, ""),
    (0.05, 0.0, 0, ""),
    (0.05, 0.01, 0, ""),
    (0.1, 0.01, 0, ""),
    (0.1, 0.05, 0, ""),
    (0.2, 0.01, 0, ""),
    (0.05, 0.0, 1, "cut"),
    (0.05, 0.0, 5, "cut"),
    (0.05, 0.0, 0, "forgotten"),
]


def serve_link(pipe, target):
    """Runs a Link in a process of its own, and does what `pipe` asks for."""
    with Link(target) as link:
        pipe.send(link.address)
        while (order := pipe.recv()) is not None:
            name, *values = order
            if name == "set":
                link.delay, link.loss = values
            else:
                getattr(link, name)()


class RemoteLink:
    """A Link in another process."""

    def __init__(self, target):
        self._pipe, other = multiprocessing.Pipe()
        self._process = multiprocessing.get_context("spawn").Process(target=serve_link, args=(other, target))
        self._process.start()
        self.address = self._pipe.recv()

    def order(self, *words):
        self._pipe.send(words)

    def close(self):
        self._pipe.send(None)
        self._process.join()


class Robot:
    """Pendulum at its own rate. Disturbs the link in the middle of the run."""

    def __init__(self, link, case, seconds):
        self.environment = gymnasium.make(TASK, max_episode_steps=EPISODE)
        self.link, self.case = link, case
        self.beats = max(EPISODE, round(seconds / PERIOD))
        self.returns, self.gaps, self.gap = [], [], 0

    def disturb(self, beat):
        _, _, cut, event = self.case
        middle = self.beats // 3
        if event == "forgotten" and beat == middle:
            self.link.order("forget")
        if event == "cut" and beat == middle:
            self.link.order("cut")
        if event == "cut" and beat == middle + round(cut / PERIOD):
            self.link.order("heal")

    def fly(self, act, end):
        """`act` returns an action and whether it is fresh. `end` ends an episode."""
        observation, _ = self.environment.reset(seed=0)
        reward, total, due = 0.0, 0.0, time.monotonic()
        for beat in range(self.beats):
            self.disturb(beat)
            action, is_fresh = act(observation, reward)
            self.gap = 0 if is_fresh else self.gap + 1
            self.gaps.append(self.gap)
            observation, reward, _, truncated, _ = self.environment.step(action)
            reward = float(reward)
            total += reward
            if truncated:
                end(reward)
                self.returns.append(total)
                observation, _ = self.environment.reset(seed=beat)
                reward, total = 0.0, 0.0
            due = max(due + PERIOD, time.monotonic() - PERIOD)
            time.sleep(max(0.0, due - time.monotonic()))
        return self


def fly_pilot(link, case, seconds, local):
    """Returns the row of a pilot."""
    robot = Robot(link, case, seconds)
    options = {"local_policy": SHIPPED_POLICIES} if local else {"local": False}
    with spikeserve.Client(link.address) as client:
        with spikeserve.Pilot(client, POLICY, PERIOD, **options) as pilot:

            def act(observation, reward):
                action = pilot.beat(observation, reward)
                return action.action, action.source == "fresh"

            robot.fly(act, lambda reward: pilot.end_episode(reward, truncated=True))
            link.order("heal")
            stats = pilot.stats()
    return {
        "fresh": stats.fresh / stats.beats,
        "held": stats.held / stats.beats,
        "local": stats.local / stats.beats,
        "safe": stats.safe / stats.beats,
        "longest": max(robot.gaps) * PERIOD,
        "p50": stats.age_p50,
        "p99": stats.age_p99,
        "return": float(np.mean(robot.returns)),
    }


def fly_calls(link, case, seconds):
    """Returns the row of a call per beat with the period as its timeout, which holds the last action."""
    robot = Robot(link, case, seconds)
    fresh = 0
    last = np.zeros(1, np.float32)
    options = spikeserve.ClientOptions(connect_timeout=30)
    with spikeserve.Client(link.address, options) as client, client.open_session(POLICY, reopen=True) as session:

        def act(observation, reward):
            nonlocal fresh, last
            with contextlib.suppress(spikeserve.DeadlineExceededError, spikeserve.UnavailableError):
                last = session.act(observation, reward, timeout=PERIOD, executed_action=last).action
                fresh += 1
                return last, True
            return last, False

        def end(reward):
            with contextlib.suppress(spikeserve.SpikeserveError):
                session.end_episode(reward, truncated=True, executed_action=last)

        robot.fly(act, end)
        link.order("heal")
    return {
        "fresh": fresh / robot.beats,
        "held": 1 - fresh / robot.beats,
        "longest": max(robot.gaps) * PERIOD,
        "return": float(np.mean(robot.returns)),
    }


def name_of(case):
    """Returns what a case is, for the table."""
    round_trip, loss, cut, event = case
    text = f"{1000 * round_trip:g} ms"
    if loss:
        text += f", {loss:.0%} lost"
    if event == "cut":
        text += f", cut for {cut} s"
    if event == "forgotten":
        text += ", connection forgotten"
    return text


def percent(row, name):
    return f"{100 * row[name]:.1f} %" if name in row else ""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--server", default=str(ROOT / "build/release/bin/spikeserve"))
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--json", help="file for the figures")
    arguments = parser.parse_args()
    os.environ["SPIKESERVE_PROGRAM"] = arguments.server
    rows = []
    print("| round trip | robot | fresh | held | local | safe | longest without fresh | age p50, p99 | return |")
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    with running_server() as server:
        for case in CASES:
            players = {
                "call per beat": fly_calls,
                "pilot": lambda *run: fly_pilot(*run, local=False),
                "pilot with engine": lambda *run: fly_pilot(*run, local=True),
            }
            for player, fly in players.items():
                link = RemoteLink(server.grpc)
                link.order("set", case[0] / 2, case[1])
                row = fly(link, case, arguments.seconds)
                link.close()
                rows.append({"case": name_of(case), "robot": player} | row)
                shares = " | ".join(percent(row, name) for name in ("fresh", "held", "local", "safe"))
                ages = f"{1000 * row['p50']:.0f}, {1000 * row['p99']:.0f} ms" if "p50" in row else ""
                print(
                    f"| {name_of(case)} | {player} | {shares} | {row['longest']:.2f} s | {ages} | {row['return']:.0f} |",
                    flush=True,
                )
    if arguments.json:
        pathlib.Path(arguments.json).write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
