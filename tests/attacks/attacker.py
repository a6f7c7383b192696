"""Runs one attack in a process of its own, and prints what it sent as JSON.

usage: python3 -m tests.attacks.attacker NAME HOST:PORT SECONDS [COUNT]
"""

import dataclasses
import json
import sys

from tests.attacks.catalogue import ATTACKS

if __name__ == "__main__":
    name, address, seconds, *count = sys.argv[1:]
    host, _, port = address.rpartition(":")
    sent = ATTACKS[name].run((host, int(port)), float(seconds), *map(int, count))
    print(json.dumps(dataclasses.asdict(sent)))
