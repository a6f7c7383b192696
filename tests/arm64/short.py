"""Runs with qemu what must not differ on arm64, and fails if any of it ran no test.

Golden answers, parity of the engines, the unit tests of the kernels, of the portable functions, of sessions, of their stores
and of roll-outs, and a client that plays CartPole on this machine's server. Each program has two hours.

usage: short.py [--targets]   --targets prints what must be built, and runs nothing
"""

import concurrent.futures
import os
import pathlib
import re
import resource
import subprocess
import sys

ROOT = pathlib.Path(__file__).parents[2]
BUILD = ROOT / "build/arm64"
EMULATE = ROOT / "tests/arm64/emulate.sh"
PROGRAMS = ["golden_test", "engine_parity_test", "engine_test", "math_test", "base_test", "agent_test", "journal_test"]
PROGRAMS += ["fleet_test", "open_sessions_test", "server_store_test", "server_rollouts_test"]
CLIENT = "client_cart_pole"
SERVER = ROOT / "build/release/bin/spikeserve"
SHARDS = os.cpu_count() or 1
TRIES = 10  # of a client, which waits three seconds for its server: too short for two emulated programs on a busy machine
LIMIT = 7200  # seconds that a program may take; the longest takes two minutes on two idle cores, and half an hour on busy ones


def run_shard(program, shard):
    command = [EMULATE, BUILD / "tests" / program]
    sharding = {"GTEST_TOTAL_SHARDS": str(SHARDS), "GTEST_SHARD_INDEX": str(shard)}
    limit = ["timeout", "--kill-after=10", str(LIMIT)]
    piped = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.run([*limit, *command], env=os.environ | sharding, check=False, **piped)


def run_tests(program, pool):
    """Returns whether all tests of a program passed and there were some, and prints their number."""
    shards = list(pool.map(lambda shard: run_shard(program, shard), range(SHARDS)))
    output = "".join(shard.stdout for shard in shards)
    passed = sum(map(int, re.findall(r"^\[  PASSED  \] (\d+) tests?\.$", output, re.MULTILINE)))
    targets = set(re.findall(r"^SIMD targets: (.*)$", output, re.MULTILINE))
    print(f"{program}: {passed} tests passed", *(f"on {each}" for each in targets), flush=True)
    for shard in shards:
        if shard.returncode != 0:
            print(shard.stdout)
            print(f"{program}: exit status: expected 0, received {shard.returncode} (124: longer than {LIMIT} s)", flush=True)
    return passed > 0 and all(shard.returncode == 0 for shard in shards)


def play(server, client, policies="deploy/policies", expected="500.0"):
    """Returns whether a client, whose command "{}" in `client` completes with the address, prints the best return of CartPole."""
    command = [*server, f"--policies={policies}", "--listen=127.0.0.1:0", "--http_listen="]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as serving:
        address = next(line.split()[-1] for line in serving.stdout if "serving gRPC on" in line)
        run = [str(word).format(address) for word in client]
        for _ in range(TRIES):
            played = subprocess.run(run, stdout=subprocess.PIPE, text=True, check=False)
            if played.returncode == 0:
                break
        serving.terminate()
    print(played.stdout or "the client printed nothing", flush=True)
    return played.returncode == 0 and serving.returncode == 0 and expected in played.stdout


def main(arguments):
    if arguments == ["--targets"]:
        print(*PROGRAMS, CLIENT)
        return 0
    with concurrent.futures.ThreadPoolExecutor(SHARDS) as pool:
        results = [run_tests(program, pool) for program in PROGRAMS]
    results.append(play([SERVER], [EMULATE, BUILD / "tests" / CLIENT, "{}", "3000000"], expected="return 500\n"))
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"processor time: {used.ru_utime + used.ru_stime:.0f} s", flush=True)
    return 0 if all(results) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
