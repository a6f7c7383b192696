"""Measures spikeserve under load, beside an echo service on gRPC's own C++ server that decides nothing.

The server has one core and the load generator the others. Everything that a server in use has is on: sessions, metrics,
limits, and tokens, which the calls carry. The echo has none of it.
"""

import contextlib
import hashlib
import json
import os
import pathlib
import shutil
import statistics
import subprocess
import sys
import tempfile

import programs

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))
from past_policies import past_policy  # noqa: E402

ROOT = pathlib.Path(__file__).parents[2]
BENCH = pathlib.Path(__file__).parent
SHIPPED = past_policy("cartpole", 1)  # in float32
SHIPPED_INTEGER = past_policy("cartpole", 3)  # the same policy in integers
POLICIES = ROOT / "deploy/policies"  # those of today
VERSIONS = {"float32": "1", "integer": "3"}

SESSIONS = [1, 8, 64, 512]
BATCH = 64  # requests
EPISODE_STEPS = 200  # as spikeload
OWN_SESSIONS = 64
# The least share of the echo's rate that each policy shall have on observations of its own episodes.
OWN_SHARES = {"unary": 0.8, "stream": 0.6}
# Bound of the initial states of CartPole. The shipped policy was trained to emit few spikes there.
OBSERVATION_BOUND = 0.05
TOKEN = "bench"
COST = "processor_seconds_per_decision"
# With this many cores, the load generator has cores of its own beside two loops.
CORES_FOR_LOOPS = 4


def summarize(rounds):
    """Returns the median of every key over the rounds, which are dicts of numbers."""
    return {key: statistics.median(r[key] for r in rounds) for key in rounds[0]}


def load_flags(mode, sessions):
    """Returns the flags of spikeload for a mode. A batch holds BATCH requests, or all sessions if there are fewer."""
    streams = -(-sessions // BATCH) if mode == "batch" else min(8, sessions)
    flags = {"mode": mode, "sessions": sessions, "streams": streams}
    return {**flags, "policy": SHIPPED.parts[-3], "observation_bound": OBSERVATION_BOUND}


def policy_folder(folder, arithmetic):
    """Makes a folder of policies with the shipped CartPole policy in one arithmetic. Returns its path."""
    version = VERSIONS[arithmetic]
    policy = folder / arithmetic / SHIPPED.parts[-3]
    policy.mkdir(parents=True)
    shutil.copytree(SHIPPED.parents[1] / version, policy / version)
    return policy.parent


def token_files(folder):
    """Writes the server's tokens and the token of the load. Returns their paths."""
    entry = {"sha256": hashlib.sha256(TOKEN.encode()).hexdigest(), "tenant": "bench", "role": "agent"}
    tokens, token = folder / "tokens.json", folder / "token"
    limits = {"decisions_per_second": 10_000_000, "max_sessions": 100_000}  # counted, and never reached
    tokens.write_text(json.dumps({"tenants": {"bench": limits}, "tokens": [entry]}))
    token.write_text(TOKEN)
    return tokens, token


class Bench:
    """The programs of the benchmark and the files that they need. `folder` is empty and outlives it."""

    def __init__(self, arguments, folder):
        self._bin = arguments.bin
        self.folder = pathlib.Path(folder)
        self._duration = f"{arguments.seconds}s"
        self._tokens, self._token = token_files(self.folder)
        self._policies = {arithmetic: policy_folder(self.folder, arithmetic) for arithmetic in VERSIONS}

    def spikeserve(self, arithmetic=None, cores=programs.MEASURED_CORE, flags=()):
        """Starts spikeserve with one loop, unless `flags` say otherwise, and POLICIES, or one policy in `arithmetic`."""
        policies = self._policies[arithmetic] if arithmetic else POLICIES
        command = [self._bin / "spikeserve", f"--policies={policies}", "--listen=127.0.0.1:0"]
        command += ["--http_listen=", "--loops=1", f"--tokens={self._tokens}", *flags]
        return programs.running_server(command, programs.SPIKESERVE, cores)

    def echo(self):
        """Starts the echo service."""
        return programs.running_server([self._bin / "echo_server"], "listening on ")

    @contextlib.contextmanager
    def servers(self):
        """Starts spikeserve in each arithmetic and the echo service. Yields them by name."""
        with contextlib.ExitStack() as stack:
            servers = {name: stack.enter_context(self.spikeserve(name)) for name in VERSIONS}
            yield {**servers, "echo": stack.enter_context(self.echo())}

    def load(self, server, mode, sessions, cores=programs.LOAD_CORES, **flags):
        """Loads a server for the duration of a measurement. Returns the report."""
        flags = {**load_flags(mode, sessions), "duration": self._duration, "token_file": self._token, **flags}
        return programs.measure_load(self._bin / "spikeload", server, cores, **flags)


@contextlib.contextmanager
def prepared(arguments):
    """Yields a Bench."""
    with tempfile.TemporaryDirectory() as folder:
        yield Bench(arguments, folder)


def share(measured, case, key, name, of="echo"):
    """Returns the median over rounds of the ratio of `key` between the servers `name` and `of`."""
    pairs = zip(measured[name][case], measured[of][case], strict=True)
    return statistics.median(ours[key] / theirs[key] for ours, theirs in pairs)


def closed_loop(bench, servers, rounds):
    """Returns the reports of closed loops, by server, by mode and number of sessions, one of each round."""
    cases = [(mode, sessions) for mode in ("unary", "stream", "batch") for sessions in SESSIONS]
    measured = {name: {case: [] for case in cases} for name in servers}
    for _ in range(rounds):
        for case in cases:
            for name, server in servers.items():
                measured[name][case].append(bench.load(server, *case))
    return measured


def half_peak(bench, servers, rounds, peaks):
    """Returns the latencies at half of the peak rate of each of spikeserve's servers, and of the echo at the same rate."""
    sessions, results = SESSIONS[-1], []
    for mode in ("unary", "stream"):
        for name in VERSIONS:
            measured = {name: [], "echo": []}
            for _ in range(rounds):
                for server, reports in measured.items():
                    rate = peaks[name][mode, sessions] / 2
                    reports.append(bench.load(servers[server], mode, sessions, rate=rate))
            case = {"mode": mode, "sessions": sessions, "server": name}
            results.append({**case, "spikeserve": summarize(measured[name]), "echo": summarize(measured["echo"])})
    return results


def batch_share(bench, arguments, servers, rounds):
    """Compares the rate of ActBatch with that of the engine alone, for as many sessions and like requests, in turns."""
    command = [arguments.bin / "engine_bench", f"--policy={SHIPPED}", f"--together={BATCH}"]
    command += [f"--episode_steps={EPISODE_STEPS}", f"--observation_bound={OBSERVATION_BOUND}"]  # as spikeload
    commands = {"float32": command, "integer": [command[0], f"--policy={SHIPPED_INTEGER}", *command[2:]]}
    shares = {name: [] for name in commands}
    with programs.running_contestants(commands) as contestants:
        for _ in range(rounds):
            for contestant in contestants:
                measured = contestant.measure(arguments.seconds)
                rate = measured["decisions"] / measured["seconds"]
                report = bench.load(servers[contestant.name], "batch", BATCH)
                shares[contestant.name].append({"engine": rate, "server_rate": 1 / report[COST]})
    return [
        {"server": name, **summarize(rounds), "share": statistics.median(r["server_rate"] / r["engine"] for r in rounds)}
        for name, rounds in shares.items()
    ]


def loops(bench, rounds):
    """Compares two loops on two cores with one on one, under the same load.

    Where the load generator has no core of its own, the rates say nothing. Then the ratio is what the processor time of a
    call allows: two cores divided by the time with two loops, over one core divided by the time with one.
    """
    own_cores = os.cpu_count() >= CORES_FOR_LOOPS
    load_cores = "2-" if own_cores else "0-"
    results = []
    with bench.spikeserve("integer") as one, bench.spikeserve("integer", "0-1", ["--loops=2"]) as two:
        for mode in ("unary", "stream"):
            measured = {1: [], 2: []}
            for _ in range(rounds):
                for count, server in ((1, one), (2, two)):
                    measured[count].append(bench.load(server, mode, SESSIONS[-1], cores=load_cores, streams=16))
            rates = {count: [r["decisions_per_second"] for r in reports] for count, reports in measured.items()}
            costs = {count: [r[COST] for r in reports] for count, reports in measured.items()}
            by_rate = [b / a for a, b in zip(rates[1], rates[2], strict=True)]
            by_cost = [2 * a / b for a, b in zip(costs[1], costs[2], strict=True)]
            results.append(
                {
                    "mode": mode,
                    "sessions": SESSIONS[-1],
                    "own_cores": own_cores,
                    "ratio": statistics.median(by_rate if own_cores else by_cost),
                    **{f"loops_{count}": statistics.median(values) for count, values in rates.items()},
                    **{f"cost_{count}": statistics.median(values) for count, values in costs.items()},
                }
            )
    return results


def measure_servers(arguments):
    """Measures closed-loop rates by mode and sessions, latencies at half of the peak rate, batches, and two loops."""
    rounds, rate = min(arguments.rounds, 5), "decisions_per_second"
    with prepared(arguments) as bench:
        with bench.servers() as servers:
            measured = closed_loop(bench, servers, rounds)
            peaks = {
                name: {case: summarize(reports)[rate] for case, reports in measured[name].items()} for name in VERSIONS
            }
            latencies = half_peak(bench, servers, rounds, peaks)
            batches = batch_share(bench, arguments, servers, rounds)
        scaling = loops(bench, rounds)
    return {
        "closed_loop": [
            {
                "mode": case[0],
                "sessions": case[1],
                **{name: summarize(reports[case]) for name, reports in measured.items()},
                "share_of_echo": {name: share(measured, case, rate, name) for name in VERSIONS},
                "processor_share_of_echo": {name: 1 / share(measured, case, COST, name) for name in VERSIONS},
            }
            for case in measured["echo"]
        ],
        "half_peak": latencies,
        "batch": batches,
        "loops": scaling,
        "torch_server": measure_torch_server(arguments),
    }


def record_episode(arguments, policy, path):
    """Writes an episode that a policy plays to `path`, as spikeload reads it. Returns its steps, 0 without its environment."""
    file = max(policy.iterdir(), key=lambda version: int(version.name)) / "policy.safetensors"  # the default
    command = [arguments.bin / "engine_bench", f"--policy={file}", f"--print_episode={EPISODE_STEPS}"]
    played = subprocess.run(command, capture_output=True, text=True)
    path.write_text(played.stdout)
    return played.stdout.count("\n")


def measure_own_observations(arguments):
    """Measures the default version of every shipped policy on the observations of its own episodes, as a share of the echo."""
    results = []
    with prepared(arguments) as bench, bench.spikeserve() as server, bench.echo() as echo:
        for policy in sorted(POLICIES.iterdir()):
            episode = bench.folder / f"{policy.name}.csv"
            steps = record_episode(arguments, policy, episode)
            if steps == 0:
                continue  # its environment is one of Gymnasium's
            for mode in OWN_SHARES:
                flags = {"policy": policy.name, "observations": episode, "episode_steps": steps}
                rounds = []
                for _ in range(arguments.rounds):
                    ours, theirs = (bench.load(each, mode, OWN_SESSIONS, **flags) for each in (server, echo))
                    rate = "decisions_per_second"
                    shares = {"share_of_echo": ours[rate] / theirs[rate], "processor_share_of_echo": theirs[COST] / ours[COST]}
                    rounds.append({rate: ours[rate], **shares})
                results.append({"policy": policy.name, "mode": mode, **summarize(rounds)})
    return results


def measure_learning(arguments):
    """Measures 64 sessions that learn, as a share of 64 frozen sessions in the same round."""
    sessions = 64
    cases = [(mode, scope) for mode in ("unary", "stream") for scope in ("fleet", "session")]
    rounds = {case: [] for case in cases}
    with prepared(arguments) as bench, bench.spikeserve("integer") as server:
        for _ in range(arguments.rounds):
            for mode, scope in cases:
                frozen = bench.load(server, mode, sessions)
                learning = bench.load(server, mode, sessions, learning_scope=scope)
                keys = ("decisions_per_second", COST)
                shares = {f"share_of_{key}": learning[key] / frozen[key] for key in keys}
                rounds[mode, scope].append({**{key: learning[key] for key in keys}, **shares})
    return [
        {"mode": mode, "scope": scope, "sessions": sessions, **summarize(rounds[mode, scope])} for mode, scope in cases
    ]


@contextlib.contextmanager
def running_torch_server(arguments):
    """Starts the Python server."""
    with tempfile.TemporaryDirectory() as stubs:
        proto = ROOT / "proto"
        subprocess.run(
            [arguments.python, "-m", "grpc_tools.protoc", f"-I{proto}", f"--python_out={stubs}"]
            + [f"--grpc_python_out={stubs}", proto / "spikeserve/v1/policy_service.proto"],
            check=True,
        )
        command = [arguments.python, BENCH / "torch_server.py", SHIPPED, stubs]
        with programs.running_server(command, "listening on ") as server:
            yield server


def measure_torch_server(arguments):
    """Measures the Python server."""
    with prepared(arguments) as bench, running_torch_server(arguments) as server:
        return [{"sessions": n, **bench.load(server, "unary", n)} for n in SESSIONS[:3]]
