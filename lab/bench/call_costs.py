#!/usr/bin/env python3
"""Measures the processor time of each method on the event loop and on the workers, with a thousand versions.

Prints a Markdown table of microseconds a call, from the kernel's account of the threads, so that waiting and the
client do not count. The methods and their requests are those of tests/python/server/test_call_costs.py. The time on the loop
includes reading the request and writing the answer.

    build/venv/bin/python lab/bench/call_costs.py --server=build/release/bin/spikeserve
"""

import argparse
import contextlib
import json
import os
import pathlib
import sys
import tempfile

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests/python"), str(ROOT / "tests/python/server")]

from gymnasium import make  # noqa: E402
from random_policy import export_random  # noqa: E402
from security import POLICY, TOKENS, service_with  # noqa: E402
from serving import running_server, schedule_of  # noqa: E402
from test_call_costs import METHODS, UNARY, called, with_session  # noqa: E402

THREADS = ("loop", "worker")
UNCHANGED = ("Drain", "ReloadPolicies")  # these change what the others meet, or read all files


def main():
    """Starts a server with many versions, calls every method, prints the table."""
    parser = argparse.ArgumentParser(prog="call_costs.py", description=__doc__)
    parser.add_argument("--server", required=True, help="the program")
    parser.add_argument("--versions", type=int, default=1000, help="of one policy [1000]")
    parser.add_argument("--calls", type=int, default=200, help="of each method [200]")
    arguments = parser.parse_args()
    os.environ["SPIKESERVE_PROGRAM"] = arguments.server
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        folder = pathlib.Path(name)
        export_random(folder / "one", "small", make("CartPole-v1"))
        file = folder / "one" / "small" / "1" / "policy.safetensors"
        for version in range(1, arguments.versions + 1):
            copy = folder / "many" / "small" / str(version) / file.name
            copy.parent.mkdir(parents=True)
            os.link(file, copy)
        unlimited = {"calls_per_second": dict.fromkeys(("light", "listing", "explain", "operator"), 0)}
        tenants = dict.fromkeys(TOKENS["tenants"], unlimited)
        (folder / "tokens.json").write_text(json.dumps(TOKENS | {"tenants": tenants}))
        flags = [f"--tokens={folder}/tokens.json", "--loops=1"]
        addresses = stack.enter_context(running_server(folder / "many", flags=flags))
        pid = addresses.process.pid
        services = {
            service: stack.enter_context(service_with(addresses, "machine", service))
            for service in METHODS
        }
        print("| method | class | on the loop, us | on workers, us | answer, bytes |")
        print("| --- | --- | ---: | ---: | ---: |")
        for service, method in UNARY:
            if method in UNCHANGED:
                continue
            cost, request = METHODS[service][method]
            session = services[POLICY].OpenSession(policy="small").session_id
            request = with_session(request, session)
            before = [schedule_of(pid, thread)[0] for thread in THREADS]
            for _ in range(arguments.calls):
                _, size = called(services[service], method, request)
            after = [schedule_of(pid, thread)[0] for thread in THREADS]
            loop, worker = (
                1e6 * (b - a) / arguments.calls for a, b in zip(before, after, strict=True)
            )
            print(f"| {method} | {cost} | {loop:.0f} | {worker:.0f} | {size} |", flush=True)


if __name__ == "__main__":
    main()
