#!/usr/bin/env python3
"""What one tenant's flood does to another tenant's latency.

Starts a server with two tenants, one of them limited; measures the other's percentiles alone, then
while the limited one calls as fast as it can, and prints both as JSON. Needs nothing but Python.

    loadtest/flood_bench.py --bin=build/release/bin --policies=deploy/policies
"""

import argparse
import hashlib
import json
import os
import pathlib
import subprocess
import tempfile


def entry(token, tenant):
    digest = hashlib.sha256(token.encode()).hexdigest()
    return {"sha256": digest, "tenant": tenant, "role": "agent"}


def spikeload(arguments, address, token, sessions, duration):
    return subprocess.Popen(
        [
            str(arguments.bin / "spikeload"),
            f"--server={address}",
            "--policy=cartpole",
            f"--sessions={sessions}",
            f"--duration={duration}",
            "--mode=stream",
            "--json",
        ],
        env={**os.environ, "SPIKESERVE_TOKEN": token},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def report(process):
    output, _ = process.communicate()
    return json.loads(output)


def measure(arguments, address):
    """The neighbour's report alone, its report beside the flood, and the flood's."""
    seconds = arguments.seconds
    alone = report(spikeload(arguments, address, "neighbour", 16, f"{seconds}s"))
    flood = spikeload(arguments, address, "flood", arguments.flood, f"{seconds + 2}s")
    beside = report(spikeload(arguments, address, "neighbour", 16, f"{seconds}s"))
    return alone, beside, report(flood)


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--bin", type=pathlib.Path, default=pathlib.Path("build/release/bin"))
    parser.add_argument("--policies", default="deploy/policies")
    parser.add_argument("--seconds", type=int, default=10, help="of each measurement")
    parser.add_argument("--flood", type=int, default=64, help="sessions of the tenant that floods")
    parser.add_argument("--limit", type=float, default=500, help="its decisions a second")
    arguments = parser.parse_args()

    with tempfile.TemporaryDirectory() as folder:
        tokens = pathlib.Path(folder) / "tokens.json"
        tenants = {"neighbour": {}, "flood": {"decisions_per_second": arguments.limit}}
        entries = [entry(tenant, tenant) for tenant in tenants]
        tokens.write_text(json.dumps({"tenants": tenants, "tokens": entries}))
        server = subprocess.Popen(
            [
                str(arguments.bin / "spikeserve"),
                f"--policies={arguments.policies}",
                f"--tokens={tokens}",
                "--listen=127.0.0.1:0",
                "--http_listen=",
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            address = server.stdout.readline().rsplit(maxsplit=1)[-1]
            alone, beside, flood = measure(arguments, address)
        finally:
            server.terminate()
            server.wait()
    figures = ("decisions_per_second", "p50_seconds", "p99_seconds")
    print(
        json.dumps(
            {
                "alone": {figure: alone[figure] for figure in figures},
                "beside_the_flood": {figure: beside[figure] for figure in figures},
                "p99_ratio": beside["p99_seconds"] / alone["p99_seconds"],
                "flood": {"decisions": flood["decisions"], "refused": flood["errors"]},
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
