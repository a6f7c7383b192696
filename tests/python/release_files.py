"""Makes and uses the files that a release leaves behind: stores, settings, recordings and the audit log.

tests/releases has a folder for each release. Run this file with the program of a release to make its folder:

    SPIKESERVE_PROGRAM=.../spikeserve build/venv/bin/python tests/python/release_files.py tests/releases/0.1.0
"""

import contextlib
import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import tempfile

from google.protobuf import json_format
from policy_file import read_policy
from redis_servers import Redis
from security import until
from serving import SHIPPED_POLICIES, running_server

RELEASES = pathlib.Path(__file__).parents[1] / "releases"
POLICIES = {"cartpole-sparse": [1, 2], "cartpole-frugal": [2]}
SESSIONS = 8
BEFORE, AFTER = 23, 25  # decisions of each session; a snapshot is written every 16
FLEET = "f" * 32
# The files are used long after they were made.
KEEP = ["--store_retention=1000000h", "--session_ttl=10m"]


def convert_int8(folder):
    """Converts the policies in int8 below a folder to float32, in place. Returns their names and versions."""
    converted = []
    for path in sorted(folder.glob("*/*/policy.safetensors")):
        if json.loads(read_policy(path)[1]["config"]).get("arithmetic") == "int8":
            command = [os.environ["SPIKETRAIN_PROGRAM"], "quantize", f"--policy={path}", f"--out={path}", "--to=float32"]
            subprocess.run(command, check=True, timeout=60)
            converted.append((path.parent.parent.name, path.parent.name))
    return converted


def opening(i):
    """Returns the request that opens session i: greedy, sampled, or learning by itself."""
    fields = {
        "session_id": f"{i:032x}",
        "policy": ["cartpole-sparse", "cartpole-frugal"][i % 2],
        "seed": i,
        "durability": "SYNC",
        "record": True,
        "labels": {"robot": str(i)},
    }
    if i >= 2:
        fields |= {"action_selection": "SAMPLE", "temperature": 0.7}
    if i >= 4:
        fields["learning"] = {"modulator": "target", "learning_rate": 0.05}
    if i >= 6:
        fields["learning"] = {"modulator": "realized", "learning_rate": 0.5}
    return fields


def decide(service, session, decision, step):
    """Returns what a decision decided, as JSON. Statistics beside it may become more with a release."""
    observation = [0.02 * ((7 * decision + 3 * k) % 11 - 5) for k in range(4)]
    answer = service.Act(
        session_id=session, step=step, decision=decision, observation=observation, reward=1.0
    )
    action = answer.action.discrete
    return [answer.step, action, answer.stats.spikes, answer.return_to_go, *answer.action_probabilities]


def play_first_half(service, admin):
    """Opens the sessions, ends one episode of each, and leaves them within the second. Changes settings."""
    admin.SetDefaultVersion(policy="cartpole-sparse", version=1)
    admin.SetLabel(policy="cartpole-sparse", label="stable", version=2)
    learning = {"scope": "FLEET", "modulator": "target", "learning_rate": 0.05}
    service.OpenSession(
        session_id=FLEET, policy="cartpole-sparse", action_selection="SAMPLE", learning=learning, seed=1
    )
    for session in [opening(i)["session_id"] for i in range(SESSIONS)] + [FLEET]:
        if session != FLEET:
            service.OpenSession(**opening(int(session, 16)))
        for decision in range(BEFORE):
            if decision == 10:
                service.EndEpisode(session_id=session, reward=1.0, terminated=True, episode=0, steps=10)
            decide(service, session, decision, decision if decision < 10 else decision - 10)


def play_second_half(service, _, sessions=range(SESSIONS)):
    """Continues with sessions and that of the fleet. Returns what the server answered, as JSON."""
    settings = service.ListPolicies()
    answers = {"policies": json_format.MessageToDict(settings, preserving_proto_field_name=True)}
    for session in [opening(i)["session_id"] for i in sessions] + [FLEET]:
        answers[session] = [
            decide(service, session, decision, decision - 10) for decision in range(BEFORE, BEFORE + AFTER)
        ]
        view = service.GetSession(session_id=session, include_head_delta=True)
        answers[session].append(json_format.MessageToDict(view, preserving_proto_field_name=True))
    return answers


@contextlib.contextmanager
def server_of(folder, store, policies=None):
    """Starts a server with the files of `folder` and yields its services."""
    flags = [
        *(f"--session_store={store}", f"--policy_settings={folder}/settings.json"),
        *(f"--audit_log={folder}/audit.jsonl", f"--record_dir={folder}/recordings", *KEEP),
    ]
    with running_server(policies or folder / "policies", flags=flags) as addresses:
        yield (
            addresses.agent,
            addresses.admin,
        )


@contextlib.contextmanager
def redis_of(folder):
    """Starts a Redis with the dump in `folder`, if there is one. Writes the dump there in the end."""
    redis = Redis("--dir", str(folder), "--dbfilename", "dump.rdb", password="")
    try:
        until(lambda: redis.command("PING") == b"PONG")
        yield redis
        redis.command("SAVE")
    finally:
        redis.process.send_signal(signal.SIGKILL)
        redis.process.wait()


def make(folder):
    """Makes the folder of a release with the program SPIKESERVE_PROGRAM, which is of that release."""
    folder.mkdir(parents=True)
    for policy, versions in POLICIES.items():
        for version in versions:
            shutil.copytree(SHIPPED_POLICIES / policy / str(version), folder / "policies" / policy / str(version))
    for kind in ("file", "redis"):
        state = folder / kind
        state.mkdir()
        with contextlib.ExitStack() as stack:
            store = store_in(state, stack)
            with server_of(state, store, folder / "policies") as services:
                play_first_half(*services)
            with tempfile.TemporaryDirectory() as scratch, contextlib.ExitStack() as copied:
                if kind == "redis":
                    store.redis.command("SAVE")
                copy = pathlib.Path(scratch) / kind
                shutil.copytree(state, copy)
                with server_of(copy, store_in(copy, copied), folder / "policies") as services:
                    answers = play_second_half(*services)
        (state / "answers.json").write_text(json.dumps(answers, sort_keys=True) + "\n")
        for lock in state.glob("sessions/*lock*"):
            lock.unlink()
        shutil.make_archive(state / "recordings", "tar", state, "recordings")
        shutil.rmtree(state / "recordings")


class RedisStore(str):
    """The address of a store in Redis, and the server."""

    redis: Redis


def store_in(state, stack):
    """Returns the --session_store of the folder `file` or `redis`; starts a Redis for the latter."""
    if state.name == "file":
        return f"file:{state}/sessions"
    redis = stack.enter_context(redis_of(state))
    store = RedisStore(f"redis://127.0.0.1:{redis.port}")
    store.redis = redis
    return store


@contextlib.contextmanager
def server_on(state):
    """Starts a server on the files of a folder `file` or `redis` beside `policies`, and yields its services."""
    with contextlib.ExitStack() as stack:
        yield stack.enter_context(server_of(state, store_in(state, stack), state.parent / "policies"))


def assert_contains(received, expected, where="answers"):
    """Asserts that an answer has everything of an older one. A newer server may say more."""
    if isinstance(expected, dict):
        for name, value in expected.items():
            assert name in received, f"{where}.{name}"
            assert_contains(received[name], value, f"{where}.{name}")
    elif isinstance(expected, list):
        assert len(received) == len(expected), where
        for i, value in enumerate(expected):
            assert_contains(received[i], value, f"{where}[{i}]")
    else:
        assert received == expected, where


if __name__ == "__main__":
    make(pathlib.Path(sys.argv[1]).resolve())
