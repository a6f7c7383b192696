"""Starts the programs of the benchmark, each on its own processor cores."""

import contextlib
import json
import subprocess
import time

# The first core runs the measured program, the other cores run the load generators. "1-": from core 1 to the last one.
MEASURED_CORE = "0"
LOAD_CORES = "1-"
ALL_CORES = "0-"

SPIKESERVE = "spikeserve: serving gRPC on "  # begins its first line

CPUCLOCK_SCHED = 2  # Linux: the lowest bits of the clock id of a process, which select its processor time


def on_cores(cores, command):
    last = subprocess.run(["nproc", "--all"], check=True, capture_output=True, text=True).stdout
    cores = cores if not cores.endswith("-") else cores + str(max(int(last) - 1, int(cores[:-1])))
    return ["taskset", "--cpu-list", cores, *map(str, command)]


class Contestant:
    """A process that measures itself in rounds. See contestant.h."""

    def __init__(self, name, command):
        self.name = name
        self.rounds = []
        self.process = subprocess.Popen(
            on_cores(MEASURED_CORE, command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def wait_until_ready(self):
        line = self.process.stdout.readline()
        if line != "ready\n":
            raise RuntimeError(f"{self.name}: expected 'ready', received {line!r}")

    def measure(self, seconds):
        """Runs one round and returns its decisions, seconds and spikes."""
        self.process.stdin.write(f"{seconds}\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self.name}: expected a result, received status {self.process.wait()}")
        return json.loads(line)

    def stop(self):
        self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()


@contextlib.contextmanager
def running_contestants(commands):
    """Starts the contestants of `commands`, by name, and yields them."""
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


def processor_seconds(pid):
    """Returns the processor seconds of a process, including its ended threads, from clock_getcpuclockid(3)."""
    return time.clock_gettime(~pid << 3 | CPUCLOCK_SCHED)


class Server:
    """A running server. `address` is its HOST:PORT."""

    def __init__(self, pid, address):
        self.pid = pid
        self.address = address

    def processor_seconds(self):
        return processor_seconds(self.pid)


@contextlib.contextmanager
def running_server(command, announcement, cores=MEASURED_CORE):
    """Starts a server and yields it. Its first line of output is `announcement` and its HOST:PORT."""
    server = subprocess.Popen(on_cores(cores, command), stdout=subprocess.PIPE, text=True)
    try:
        line = server.stdout.readline()
        if not line.startswith(announcement):
            raise RuntimeError(f"{command[0]}: expected {announcement!r}, received {line!r}")
        yield Server(server.pid, line.removeprefix(announcement).strip())
    finally:
        server.terminate()
        server.wait()
        server.stdout.close()


def measure_load(spikeload, server, cores=LOAD_CORES, **flags):
    """Returns the report of spikeload for one run, and the processor time of the server for each decision."""
    flags = {"server": server.address, **flags}
    command = [spikeload, "--json", *(f"--{name}={value}" for name, value in flags.items())]
    before = server.processor_seconds()
    result = subprocess.run(on_cores(cores, command), check=False, capture_output=True, text=True)
    if result.returncode != 0:
        raise RuntimeError(f"{' '.join(map(str, command))}: expected status 0, received {result.returncode}: {result.stderr}")
    report = json.loads(result.stdout)
    used = server.processor_seconds() - before
    return {**report, "processor_seconds_per_decision": used / report["decisions"]}
