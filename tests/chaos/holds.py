"""Holds many robots at once, of which some are cut off, and kills all servers.

usage: python -m tests.chaos.holds [--robots=N] [--cut_off=N] [--period=SECONDS]

Three servers share a Redis. Each robot asks for a decision once in a period. One call holds them all: prints how long it took
until 99.9 % of those that can be reached were known to be at their neutral action, and checks that the list names the others;
the same after all servers were killed and started again. Needs the variables SPIKESERVE_PROGRAM and SPIKELOAD_PROGRAM. Exits with
status 1 if something differs.
"""

import argparse
import contextlib
import math
import os
import pathlib
import signal
import subprocess
import sys
import time

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python")]

import spikeserve
from replicated import running_fleet
from security import until

LIMIT = 300.0  # seconds, for what has no time of its own


@contextlib.contextmanager
def running_robots(addresses, robots, period):
    """Lets robots ask until the end of the context. Yields their process."""
    command = [
        os.environ["SPIKELOAD_PROGRAM"],
        f"--server={addresses}",
        "--mode=stream",
        f"--sessions={robots}",
        "--streams=3",
    ]
    command += [f"--rate={robots / period:g}", "--policy=cartpole", "--durability=async", "--retry", "--duration=1h"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def wait_for_neutral(operator, hold_id, wanted):
    """Returns the seconds until so many robots are known to be at their neutral action."""
    begin = time.monotonic()
    until(lambda: sum(robot.at_neutral for robot in operator.verdict(hold_id, stored=False).robots) >= wanted, LIMIT)
    return time.monotonic() - begin


def complaints_of(operator, hold_id, lost, moment):
    """Yields what is wrong with the list of those that are not known to be at neutral, which are `lost`."""
    verdict = operator.verdict(hold_id)
    yield from (f"{moment}: {server}: {error}" for server, error in verdict.unreached.items())
    left = {robot.session_id for robot in verdict.not_confirmed}
    if not lost <= left:
        yield f"{moment}: the list lacks {len(lost - left)} robots that cannot be reached"
    print(
        f"{moment}: {len(left & lost)} that cannot be reached and {len(left - lost)} others are listed as not confirmed"
    )


def main():
    parser = argparse.ArgumentParser(prog="tests.chaos.holds")
    parser.add_argument("--robots", type=int, default=10_000, help="that can be reached")
    parser.add_argument("--cut_off", type=int, default=100, help="other robots, which are suspended before the call")
    parser.add_argument("--period", type=float, default=4.0, help="of the control of a robot, in seconds")
    arguments = parser.parse_args()
    complaints = []
    with contextlib.ExitStack() as stack:
        fleet = stack.enter_context(running_fleet())
        client = stack.enter_context(spikeserve.Client(fleet.addresses))
        operator = stack.enter_context(spikeserve.Operator(client, "ann"))
        admins = [stack.enter_context(spikeserve.AdminClient(server.address)) for server in fleet.replicas]

        def start(robots):
            before = sum(admin.list_sessions(page_size=1).open_sessions for admin in admins)
            process = stack.enter_context(running_robots(fleet.addresses, robots, arguments.period))
            until(
                lambda: sum(admin.list_sessions(page_size=1).open_sessions for admin in admins) == before + robots,
                LIMIT,
            )
            return process

        suspended = start(arguments.cut_off)
        lost = {session.session_id for admin in admins for session in admin.list_sessions(page_size=1000).sessions}
        suspended.send_signal(signal.SIGSTOP)
        start(arguments.robots)
        wanted = math.ceil(0.999 * arguments.robots)

        begin = time.monotonic()
        held = operator.hold(all_sessions=True, reason="drill", wait=0.0)
        called = time.monotonic() - begin
        seconds = called + wait_for_neutral(operator, held.id, wanted)
        figures = (
            f"{seconds:.2f} s after the call, which took {called:.2f} s; two periods are {2 * arguments.period:g} s"
        )
        print(f"{wanted} of {arguments.robots} robots at neutral {figures}")
        complaints += complaints_of(operator, held.id, lost, "held")

        for server in fleet.replicas:
            server.kill()
        for server in fleet.replicas:
            server.start()
        seconds = wait_for_neutral(operator, held.id, wanted)
        print(f"after kill -9 of all servers: {wanted} robots at neutral again {seconds:.2f} s after the start")
        until(lambda: lost <= {robot.session_id for robot in operator.verdict(held.id).robots}, LIMIT)
        complaints += complaints_of(operator, held.id, lost, "killed")
    print(*complaints, f"{len(complaints)} complaints", sep="\n")
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
