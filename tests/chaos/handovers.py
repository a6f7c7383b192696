"""Hands robots from operator to operator while servers are killed, cut off from the store, and suspended.

usage: python -m tests.chaos.handovers [--handovers=N] [--robots=N] [--faults=N] [--lease=SECONDS] [--pause=SECONDS]
         [--seed=N]

Three servers share a Redis. A fault lasts until the next one. Robots, half of them ASYNC and half SYNC, ask for decisions,
each after a pause. Each hand-over relieves the operator before, so that the operators of a robot are numbered. Checks that
each step has one source, that no operator is heard after a later one, and that the policy acts again when the last operator
says nothing any more; prints how long after the last word that was. Needs the variable SPIKESERVE_PROGRAM. Exits with
status 1 if something differs.
"""

import argparse
import collections
import pathlib
import random
import sys
import threading
import time

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python")]

import spikeserve
from replicated import running_fleet
from security import until

PATIENT = spikeserve.ClientOptions(connect_timeout=60.0, retry=spikeserve.RetryOptions(max_elapsed=60.0))
FAULTS = {  # how each begins and ends, for a server and its link to the store
    "killed": (lambda server, link: server.kill(), lambda server, link: server.start()),
    "cut off": (lambda server, link: link.cut(), lambda server, link: link.heal()),
    "suspended": (lambda server, link: server.stop(), lambda server, link: server.resume()),
}


class Robot(threading.Thread):
    """Asks for decisions until it is over, and keeps who chose them."""

    def __init__(self, client, durability, pause):
        super().__init__(daemon=True)
        self.session = client.open_session("cartpole", spikeserve.SessionOptions(durability=durability))
        self.durability, self.pause = durability, pause
        self.answers = []  # source and operator
        self.over = False
        self.error = None

    def run(self):
        try:
            while not self.over:
                decision = self.session.act([0.01, -0.02, 0.03, 0.1], 0.0)
                self.answers.append((decision.source, decision.operator_id))
                time.sleep(self.pause)
        except spikeserve.SpikeserveError as error:
            self.error = error

    def complaints(self):
        heard = -1
        for step, (source, operator) in enumerate(self.answers):
            if (source == "OPERATOR") != bool(operator) or source not in ("POLICY", "OPERATOR"):
                yield f"step {step}: source {source}, operator {operator!r}"
            if operator and int(operator) < heard:
                yield f"step {step}: operator {operator} after {heard}"
            heard = max(heard, int(operator or -1))
        if self.error is not None:
            yield f"ended by {self.error}"


def hand_over(client, robot, number, lease):
    """Relieves the operator before, as often as the servers are away. Returns the control."""
    operator = spikeserve.Operator(client, str(number))
    while True:
        try:
            control = operator.take(robot.session.session_id, lease, take_over=True, action=number % 2)
            control.act(number % 2)
            return control
        except (spikeserve.NotFoundError, spikeserve.UnavailableError, spikeserve.DeadlineExceededError):
            time.sleep(0.02)
        except spikeserve.FailedPreconditionError:  # the lease ended while the server was away
            continue


def main():
    parser = argparse.ArgumentParser(prog="tests.chaos.handovers")
    parser.add_argument("--handovers", type=int, default=1000)
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--faults", type=int, default=60)
    parser.add_argument("--lease", type=float, default=0.5, help="seconds")
    parser.add_argument("--pause", type=float, default=0.0, help="seconds between the decisions of a robot")
    parser.add_argument("--seed", type=int, default=1, help="of the faults")
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    with running_fleet(linked=True) as fleet, spikeserve.Client(fleet.addresses, PATIENT) as client:
        robots = [Robot(client, ("ASYNC", "SYNC")[i % 2], arguments.pause) for i in range(arguments.robots)]
        for robot in robots:
            robot.start()
        places = list(zip(fleet.replicas, fleet.links, strict=True))
        moments = set(chance.sample(range(1, arguments.handovers), arguments.faults))
        kinds = collections.Counter()
        place, end = places[0], lambda server, link: None  # of the last fault
        for number in range(arguments.handovers):
            if number in moments:
                end(*place)
                place = chance.choice([other for other in places if other is not place])
                kind = chance.choice(list(FAULTS))
                kinds[kind] += 1
                begin, end = FAULTS[kind]
                begin(*place)
            hand_over(client, robots[number % len(robots)], number, arguments.lease)
        end(*place)
        silences = []
        for robot, number in zip(robots, range(arguments.handovers, arguments.handovers + len(robots)), strict=True):
            hand_over(client, robot, number, arguments.lease)
            said = time.monotonic()
            until(lambda robot=robot: robot.answers[-1][0] == "POLICY" or robot.error)
            silences.append(time.monotonic() - said)
        print(f"the policy acts {max(silences):.2f} s after the last word at most, with leases of {arguments.lease} s")
        for robot in robots:
            robot.over = True
            robot.join()
    complaints = [f"{robot.durability}, {complaint}" for robot in robots for complaint in robot.complaints()]
    steps = sum(len(robot.answers) for robot in robots)
    steered = sum(bool(operator) for robot in robots for _, operator in robot.answers)
    heard = len({operator for robot in robots for _, operator in robot.answers if operator})
    print(f"{arguments.handovers} hand-overs, faults {dict(kinds)}: {steps} steps, {steered} by {heard} operators")
    print(*complaints[:20], f"{len(complaints)} complaints", sep="\n")
    return 1 if complaints or steered == 0 else 0


if __name__ == "__main__":
    sys.exit(main())
