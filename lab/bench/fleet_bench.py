"""Measures what it costs to keep sessions in a store: each durability beside NONE, and two replicas beside one.

The server has one core. The load generator and Redis share the others, and with two cores they are the bottleneck: there
the rates say less than the processor time of the server and of Redis for each decision, which are measured beside them.
"""

import concurrent.futures
import contextlib
import pathlib
import socket
import statistics
import subprocess
import tempfile

import programs
import server_bench
from server_bench import COST, summarize

SESSIONS = 64
REDIS_COST = "redis_processor_seconds_per_decision"


class Redis:
    """A Redis server on a port of its own, beside the load generator."""

    def __init__(self, folder):
        self._path = folder / "redis.sock"
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        command = ["redis-server", "--port", self.port, "--unixsocket", self._path, "--save", "", "--appendonly", "yes"]
        command += ["--appendfsync", "everysec", "--dir", folder]
        self.process = subprocess.Popen(
            programs.on_cores(programs.LOAD_CORES, command), stdout=subprocess.PIPE, text=True
        )
        for line in self.process.stdout:
            if "Ready to accept connections" in line:
                break

    def processor_seconds(self):
        """Returns the processor seconds of the thread that executes commands, the one that a fleet shares."""
        fields = dict(line.split(":", 1) for line in self._info("cpu").splitlines() if ":" in line)
        return float(fields["used_cpu_user_main_thread"]) + float(fields["used_cpu_sys_main_thread"])

    def _info(self, section):
        command = ["redis-cli", "-s", self._path, "INFO", section]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    def stop(self):
        self.process.terminate()
        self.process.communicate()


class FleetBench:
    """Servers with and without a store."""

    def __init__(self, arguments, folder, redis):
        self._bench = server_bench.Bench(arguments, folder)
        self._folder = folder
        self._redis = redis

    def server(self, name, core=programs.MEASURED_CORE):
        """Starts a server. `name` is none, or a durability and a store: async redis, sync file."""
        flags = []
        if name != "none":
            durability, store = name.split()
            address = f"redis://127.0.0.1:{self._redis.port}" if store == "redis" else f"file:{self._folder}/{durability}"
            flags = [f"--durability={durability}", f"--session_store={address}"]
        return self._bench.spikeserve("integer", core, flags)

    def load(self, server, mode):
        """Returns the report of a load, with the processor time of Redis for each decision."""
        before = self._redis.processor_seconds()
        report = self._bench.load(server, mode, SESSIONS)
        report[REDIS_COST] = (self._redis.processor_seconds() - before) / report["decisions"]
        return report

    def load_all(self, servers, mode):
        """Loads several servers at once, on all cores. Returns their mean cost of a decision and the sum of their rates."""
        before = self._redis.processor_seconds()
        with concurrent.futures.ThreadPoolExecutor() as threads:
            reports = list(threads.map(lambda server: self._bench.load(server, mode, SESSIONS, cores="0-"), servers))
        decisions = [report["decisions"] for report in reports]
        used = sum(report[COST] * n for report, n in zip(reports, decisions, strict=True))
        return {
            COST: used / sum(decisions),
            REDIS_COST: (self._redis.processor_seconds() - before) / sum(decisions),
            "decisions_per_second": sum(report["decisions_per_second"] for report in reports),
        }


@contextlib.contextmanager
def prepared(arguments):
    """Yields a FleetBench."""
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        redis = Redis(folder)
        try:
            yield FleetBench(arguments, folder, redis)
        finally:
            redis.stop()


def durabilities(bench, rounds):
    """Compares the durabilities with NONE, in turns."""
    names = ["none", "async redis", "sync redis", "async file", "sync file"]
    cases = {}
    with contextlib.ExitStack() as running:
        servers = {name: running.enter_context(bench.server(name)) for name in names}
        for mode in ("unary", "stream"):
            measured = {name: [] for name in names}
            for _ in range(rounds):
                for name, server in servers.items():
                    measured[name].append(bench.load(server, mode))
            cases[mode] = measured
    return [
        {
            "mode": mode,
            "server": name,
            **summarize(reports),
            "share_of_rate": ratio(reports, measured["none"], "decisions_per_second"),
            "share_of_processor": 1 / ratio(reports, measured["none"], COST),
        }
        for mode, measured in cases.items()
        for name, reports in measured.items()
    ]


def ratio(reports, others, key):
    """Returns the median over rounds of the ratio of `key`."""
    return statistics.median(a[key] / b[key] for a, b in zip(reports, others, strict=True))


def replicas(bench, rounds):
    """Compares two replicas on two cores with one on one core, all on one Redis server, under the same load each.

    The load generators run on the same cores. So the ratio is what the processor time of a decision allows: two cores
    divided by the time with two replicas, over one core divided by the time with one. Redis is not part of it.
    """
    results = []
    with contextlib.ExitStack() as running:
        alone, first, second = (running.enter_context(bench.server("async redis", core)) for core in "001")
        for mode in ("unary", "stream"):
            measured = {1: [], 2: []}
            for _ in range(rounds):
                measured[1].append(bench.load_all([alone], mode))
                measured[2].append(bench.load_all([first, second], mode))
            costs = {count: [r[COST] for r in reports] for count, reports in measured.items()}
            results.append(
                {
                    "mode": mode,
                    "ratio": statistics.median(2 * a / b for a, b in zip(costs[1], costs[2], strict=True)),
                    **{f"replicas_{count}": summarize(reports) for count, reports in measured.items()},
                }
            )
    return results


def measure_fleet(arguments):
    """Measures durabilities, and two replicas beside one."""
    rounds = min(arguments.rounds, 5)
    with prepared(arguments) as bench:
        return {"durabilities": durabilities(bench, rounds), "replicas": replicas(bench, rounds)}
