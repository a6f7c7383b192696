"""Starts a server, attacks it, and records what became of the server and of a neighbour."""

import collections
import concurrent.futures
import contextlib
import dataclasses
import multiprocessing
import pathlib
import shutil
import tempfile
import time

from gateways import running_gateway
from security import tls_flags
from serving import SHIPPED_POLICIES, running_server

from tests.attacks import catalogue, neighbour
from tests.attacks.client import seconds_until_served
from tests.attacks.process import MEGABYTE, MemoryWatch, Process

# Attackers and neighbours are forked from a process that has imported what they need.
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload([catalogue.__name__, neighbour.__name__])
KILL_BYTES = 1024 * MEGABYTE  # above idle
SERVED_SECONDS = 5
RETURN_SECONDS = 10  # in which memory has to be given back
POLL_SECONDS = 0.05


@dataclasses.dataclass
class Observation:
    """What an attack did to the server. Memory is in bytes above that of the idle server."""

    attack: str
    seconds: float
    sent: dict
    peak: int
    after: int  # at the end, or as soon as it is below the limit
    cores: float  # the server's processor time for each second of the attack
    # The neighbour's figures, see tests/attacks/neighbour.py: without the attack, while it hits another server of the
    # machine, and during it.
    calm: dict
    elsewhere: dict | None
    during: dict
    served_after: float | None  # seconds until a new client was served; None: it was not
    alive: bool


class Neighbour:
    """A process that runs tests/attacks/neighbour.py."""

    def __init__(self, *addresses):
        self._connection, theirs = FORKS.Pipe()
        self._process = FORKS.Process(target=neighbour.play, args=(theirs, *addresses), daemon=True)
        self._process.start()
        theirs.close()  # so that the end of the process ends the connection
        assert self._connection.recv() == "ready"

    def begin(self, period):
        """Begins a period, or goes on with one."""
        self._connection.send(period)

    def stop(self):
        """Ends the process. Returns the figures by period."""
        self._connection.send(None)
        figures = self._connection.recv()
        self._process.join(timeout=30)
        return figures


class Gateway:
    """A gateway: it has one port, which answers robots and health checks."""

    def __init__(self, address):
        self.grpc = str(address)  # without what running_gateway() has added
        self.http = address.removeprefix("ws://")
        self.process = address.process


@contextlib.contextmanager
def attacked_server(attack, tokens, certificates, log):
    """Starts the server that an attack needs, and yields its Addresses; with a gateway those of this one.

    Asserts that SIGTERM ends the server with status 0, unless it has ended before.
    """
    flags = [f"--tokens={tokens}", *(tls_flags(certificates) if attack.tls else [])]
    prefix = ["prlimit", f"--nofile={attack.descriptors}"] if attack.descriptors else []
    outlived = True
    with tempfile.TemporaryDirectory() as folder:
        flags += [flag.format(folder=folder) for flag in attack.flags]
        policies = SHIPPED_POLICIES if attack.versions == 0 else many_versions(folder, attack.versions)
        try:
            with contextlib.ExitStack() as stack:
                addresses = stack.enter_context(running_server(policies, flags=flags, log=log, prefix=prefix))
                if attack.gateway:
                    gateway = running_gateway(addresses.grpc, "--policy=cartpole", token="operator")
                    addresses = Gateway(stack.enter_context(gateway))
                yield addresses
                outlived = addresses.process.poll() is None
        except AssertionError:
            if outlived:
                raise


def many_versions(folder, count):
    """Writes the shipped CartPole and `count` versions of a small policy. Returns their folder."""
    policies = pathlib.Path(folder) / "policies"
    shutil.copytree(SHIPPED_POLICIES / "cartpole", policies / "cartpole")
    for version in range(1, count + 1):
        shutil.copytree(SHIPPED_POLICIES / "cartpole-small" / "1", policies / "many" / str(version))
    return policies


def _attack(name, address, seconds, *count):
    return dataclasses.asdict(catalogue.ATTACKS[name].run(address, seconds, *count))


def run_attack(name, address, seconds, count):
    """Runs an attack in another process. Returns what it sent."""
    host, _, port = address.rpartition(":")
    arguments = (name, (host, int(port)), seconds, *([count] if count else []))
    with concurrent.futures.ProcessPoolExecutor(1, FORKS) as process:
        return process.submit(_attack, *arguments).result(timeout=seconds + 30)


def memory_after(process, idle, limit):
    """Waits until the memory above idle is below `limit`, or RETURN_SECONDS. Returns it."""
    end = time.monotonic() + RETURN_SECONDS
    while (above := process.memory() - idle) > limit and time.monotonic() < end:
        time.sleep(POLL_SECONDS)
    return above


@dataclasses.dataclass
class Rounds:
    """How often an attack is made, with a calm before each time, and whether it is made elsewhere, too."""

    count: int
    seconds: float  # of each attack
    calm_seconds: float
    elsewhere: bool = False


def observe(attack, tokens, certificates, rounds, return_limit, count=None, log=None):
    """Attacks a new server, which logs to `log`, an open file; None: to stderr. Returns the Observation.

    The periods take turns, so that other work of the machine is in all of them.
    """
    with contextlib.ExitStack() as stack:
        addresses, *others = [
            stack.enter_context(attacked_server(attack, tokens, certificates, log)) for _ in range(1 + rounds.elsewhere)
        ]
        process = Process(addresses.process.pid)
        authority = [f"{certificates}/ca.pem"] if attack.tls else []
        rival = Neighbour(addresses.grpc, addresses.http, *authority)
        sent = collections.Counter()
        processor = took = 0.0
        served_after = None

        def run(server):
            target = server.http if attack.http or attack.gateway else server.grpc
            return run_attack(attack.name, target, rounds.seconds, count)

        idle = None
        for _ in range(rounds.count):
            rival.begin("calm")
            time.sleep(rounds.calm_seconds)
            for other in others:
                rival.begin("elsewhere")
                run(other)
            if idle is None:
                idle = process.memory()
                process.reset_peak()
            with MemoryWatch(process, idle + KILL_BYTES), contextlib.suppress(OSError):
                began, used = time.monotonic(), process.processor_seconds()
                rival.begin("during")
                sent.update(run(addresses))
                took += time.monotonic() - began
                processor += process.processor_seconds() - used
            served_after = seconds_until_served(addresses.grpc, attack.tls, SERVED_SECONDS)
            rival.begin("between")
            time.sleep(rounds.calm_seconds / 2)  # what the attack has left behind is done
        try:
            peak = process.peak() - idle
            after = memory_after(process, idle, return_limit)
            alive = addresses.process.poll() is None
        except OSError:
            peak, after, alive = KILL_BYTES, KILL_BYTES, False
        figures = rival.stop()
    return Observation(
        attack.name,
        took,
        dict(sent),
        peak,
        after,
        processor / max(took, 1e-9),
        figures["calm"],
        figures.get("elsewhere"),
        figures["during"],
        served_after,
        alive,
    )
