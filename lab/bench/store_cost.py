"""What a decision costs Redis, in processor time, with other ways to append an entry.

    build/venv/bin/python lab/bench/store_cost.py [--appendfsync=everysec] [--rounds=5]

Sends the commands of servers for 256 sessions in pipelines of 64, a snapshot every 16 decisions included, to a Redis server
of its own, and divides the processor time that it says it has used by the decisions:

- `blind`: RPUSHX alone, which notices the loss of the list, but not that of the hash or of what the list began with;
- `looked`: HGET and RPUSHX, as servers do;
- `script`: a script that compares first.
"""

import argparse
import secrets
import statistics
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests/python"))

from redis_servers import Redis, read_reply  # noqa: E402

SESSIONS, BATCH, DECISIONS, PER_SNAPSHOT = 256, 64, 160, 16
ENTRY, SNAPSHOT = secrets.token_bytes(180), secrets.token_bytes(1400)
OWNER, RETENTION = "o" * 32, "86400000"
COMPARE = """
local found = redis.call('HMGET', KEYS[1], 'owner', 'base')
if found[1] ~= ARGV[1] or found[2] ~= ARGV[2] then return 0 end
redis.call('HSET', KEYS[1], 'base', ARGV[2])
return redis.call('RPUSHX', KEYS[2], ARGV[3])"""
REPLACE = """
redis.call('HSET', KEYS[1], 'epoch', '1', 'owner', ARGV[1], 'tenant', '', 'state', 'open', 'policy', ARGV[4], 'base', ARGV[5])
redis.call('DEL', KEYS[2])
redis.call('RPUSH', KEYS[2], ARGV[2])
redis.call('PEXPIRE', KEYS[1], ARGV[3])
redis.call('PEXPIRE', KEYS[2], ARGV[3])
return 1"""


def encoded(*words):
    parts = [word if isinstance(word, bytes) else str(word).encode() for word in words]
    return b"*%d\r\n" % len(parts) + b"".join(b"$%d\r\n%s\r\n" % (len(part), part) for part in parts)


def snapshot(session):
    keys = (f"ss:{{{session:032x}}}:o", f"ss:{{{session:032x}}}:1")
    return [encoded("EVAL", REPLACE, 2, *keys, OWNER, SNAPSHOT, RETENTION, "p" * 90, 1)]


def entry(way, session):
    hash_key, list_key = f"ss:{{{session:032x}}}:o", f"ss:{{{session:032x}}}:1"
    if way == "script":
        return [encoded("EVAL", COMPARE, 2, hash_key, list_key, OWNER, 1, ENTRY)]
    push = encoded("RPUSHX", list_key, ENTRY)
    return [push] if way == "blind" else [encoded("HGET", hash_key, "base"), push]


def cpu_seconds(redis):
    lines = redis.command("INFO cpu").decode().split()
    values = dict(line.split(":") for line in lines if ":" in line)
    return float(values["used_cpu_user"]) + float(values["used_cpu_sys"])


def decisions_per_second(redis, way):
    """Returns how many decisions a second of processor time suffices for."""
    redis.command("FLUSHALL")
    with redis.connect() as connection:
        replies = connection.makefile("rb", buffering=1 << 20)

        def send(commands):
            connection.sendall(b"".join(commands))
            for _ in commands:
                reply = read_reply(replies)
                assert reply not in (0, None), reply

        for session in range(SESSIONS):
            send(snapshot(session))
        before = cpu_seconds(redis)
        for decision in range(1, DECISIONS + 1):
            for first in range(0, SESSIONS, BATCH):
                batch = range(first, first + BATCH)
                is_snapshot = decision % PER_SNAPSHOT == 0
                send([part for i in batch for part in (snapshot(i) if is_snapshot else entry(way, i))])
        return SESSIONS * DECISIONS / (cpu_seconds(redis) - before)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--appendfsync", default="everysec", choices=["everysec", "always"])
    parser.add_argument("--rounds", type=int, default=5)
    flags = parser.parse_args()
    redis = Redis("--appendonly", "yes", "--appendfsync", flags.appendfsync, password="")
    ways = ["blind", "looked", "script"]
    rates = {way: [] for way in ways}
    try:
        for _ in range(flags.rounds):
            for way in ways:
                rates[way].append(decisions_per_second(redis, way))
    finally:
        redis.stop()
    for way in ways:
        print(f"{way}: {statistics.median(rates[way]):,.0f} decisions a second of processor time (median of {flags.rounds})")


if __name__ == "__main__":
    main()
