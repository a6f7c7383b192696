"""Starts what the benchmark measures, each on the cores it is given."""

import contextlib
import json
import subprocess
import time

# The server and everything measured alone get the first core, load generators the others.
MEASURED_CORE = "0"
LOAD_CORES = "1-"

CPUCLOCK_SCHED = 2  # Linux: the kind of clock in the lowest bits of a process's clock id


def on_cores(cores, command):
    last = subprocess.run(["nproc", "--all"], check=True, capture_output=True, text=True).stdout
    cores = cores if not cores.endswith("-") else cores + str(max(int(last) - 1, int(cores[:-1])))
    return ["taskset", "--cpu-list", cores, *map(str, command)]


class Contestant:
    """A process that measures itself in rounds; see contestant.h."""

    def __init__(self, name, command):
        self.name = name
        self.rounds = []
        self.process = subprocess.Popen(
            on_cores(MEASURED_CORE, command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def wait_until_ready(self):
        if self.process.stdout.readline() != "ready\n":
            raise RuntimeError(f"{self.name} did not start")

    def measure(self, seconds):
        """One round; its decisions, seconds and spikes."""
        self.process.stdin.write(f"{seconds}\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self.name} ended with status {self.process.wait()}")
        return json.loads(line)

    def stop(self):
        self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()


@contextlib.contextmanager
def running_contestants(commands):
    """`commands` by name."""
    contestants = []
    try:
        for name, command in commands.items():
            contestants.append(Contestant(name, command))
        for contestant in contestants:
            contestant.wait_until_ready()
        yield contestants
    finally:
        for contestant in contestants:
            contestant.stop()


class Server:
    """A running server: where it listens, and what it has cost so far."""

    def __init__(self, pid, address):
        self.pid = pid
        self.address = address

    def processor_seconds(self):
        """Of the process, its past threads included, to the nanosecond: what clock_getcpuclockid(3) names."""
        return time.clock_gettime(~self.pid << 3 | CPUCLOCK_SCHED)


@contextlib.contextmanager
def running_server(command, announcement):
    """A Server, whose HOST:PORT follows `announcement` on the first line it prints."""
    server = subprocess.Popen(on_cores(MEASURED_CORE, command), stdout=subprocess.PIPE, text=True)
    try:
        line = server.stdout.readline()
        if not line.startswith(announcement):
            raise RuntimeError(f"{command[0]} did not start, it said {line!r}")
        yield Server(server.pid, line.removeprefix(announcement).strip())
    finally:
        server.terminate()
        server.wait()
        server.stdout.close()


def measure_load(spikeload, server, **flags):
    """What spikeload reports of one run, and the processor time that a decision costs the server."""
    flags = {"server": server.address, **flags}
    command = [spikeload, "--json", *(f"--{name}={value}" for name, value in flags.items())]
    before = server.processor_seconds()
    result = subprocess.run(on_cores(LOAD_CORES, command), check=True, capture_output=True, text=True)
    report = json.loads(result.stdout)
    used = server.processor_seconds() - before
    return {**report, "processor_seconds_per_decision": used / report["decisions"]}
