"""Versions that are pushed to a running fleet, over the wire: PushPolicy, PullPolicy and RemovePolicy."""

import contextlib
import hashlib
import json
import os
import random
import shutil
import threading
import time

import grpc
import numpy as np
import pytest
from policy_file import read_policy, write_policy
from redis_servers import WITHOUT_REDIS, Redis, stopping
from security import ADMIN, Bearer, code_of, fails_with, openssl, until
from serving import DEADLINE_SECONDS, RELEASED_POLICIES, SHIPPED_POLICIES, Service, method_of, running_server
from stored_sessions import Restartable

ACROBOT = SHIPPED_POLICIES / "acrobot/1/policy.safetensors"
OBSERVATION = [0.1] * 6
LENGTH = 500_000
PART = 20_000
KILLS = int(os.environ.get("PUSH_KILLS", "20"))  # with Redis, and as many without it; the long form has 200


@pytest.fixture(scope="module")
def make(tmp_path_factory):
    """Returns a function that makes policy files of 500 KB, which differ in their training record."""
    tensors, metadata = read_policy(ACROBOT)
    folder = tmp_path_factory.mktemp("files")

    def make_one(seed):
        path = folder / f"{seed}/policy.safetensors"
        if not path.exists():
            record = json.dumps({"seed": seed, "notes": "x" * (LENGTH - ACROBOT.stat().st_size)})
            write_policy(path, tensors, metadata | {"training": record})
        return path.read_bytes()

    return make_one


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "policies"
    shutil.copytree(SHIPPED_POLICIES / "acrobot", path / "acrobot")
    return path


def sha256(data):
    return hashlib.sha256(data).hexdigest()


def push(server, data, token=None, sent=lambda count: None, part=PART, **fields):
    """Calls PushPolicy, and `sent` with the number of bytes after each part. Returns the answer."""
    request, call = method_of(server.channel, ADMIN, "PushPolicy")
    header = {"policy": "acrobot", "sha256": sha256(data)} | fields

    def messages():
        yield request(**header)
        for at in range(0, len(data), part):
            sent(at)
            yield request(data=[data[at : at + part]])
        sent(len(data))

    metadata = [("authorization", f"Bearer {token}")] if token else None
    return call(messages(), timeout=DEADLINE_SECONDS, metadata=metadata)


def pull(server, version, policy="acrobot"):
    data = b""
    while part := server.admin.PullPolicy(policy=policy, version=version, offset=len(data)).data:
        data += part
    return data


def versions(server):
    return [each.version for each in server.agent.ListPolicies().policies if each.name == "acrobot"]


def default(server):
    return server.agent.OpenSession(policy="acrobot").version


def decide(server, version):
    session = server.agent.OpenSession(policy="acrobot", version=version).session_id
    server.agent.Act(session_id=session, observation=OBSERVATION)
    server.agent.CloseSession(session_id=session)


def contents(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@contextlib.contextmanager
def fleet(tmp_path, *flags, count=3):
    """Starts servers with one Redis, each with a folder of its own, and yields Redis and them."""
    with stopping([Redis(password="")]) as [redis], contextlib.ExitStack() as stack:
        replicas = []
        for i in range(count):
            policies = tmp_path / f"{i}"
            shutil.copytree(SHIPPED_POLICIES / "acrobot", policies / "acrobot")
            started = Restartable(f"redis://127.0.0.1:{redis.port}", flags, policies)
            replicas.append(stack.enter_context(started))
        yield redis, replicas


@WITHOUT_REDIS
def test_a_version_reaches_every_replica_and_leaves_it(tmp_path, make):
    data = make(2)
    file = tmp_path / "new.safetensors"
    file.write_bytes(data)
    with fleet(tmp_path) as (redis, replicas):
        first, second, third = replicas
        keys = sorted(redis.command("KEYS pf:*"))
        start = time.monotonic()
        pushed = json.loads(first.spikectl("push", file, "--policy=acrobot", "--json").stdout)
        assert (pushed["version"], pushed["existed"], pushed["after"]["default_version"]) == (2, False, 1)
        for replica in replicas:
            until(lambda replica=replica: code_of(decide, replica, 2) == grpc.StatusCode.OK)
            print(f"first decision {time.monotonic() - start:.2f} s after spikectl push of {len(data)} bytes began")
        out = tmp_path / "pulled"
        third.spikectl("pull", out, "--policy=acrobot", "--version=2")
        assert out.read_bytes() == data == pull(second, 2)
        # The same file again changes nothing, and one step more rolls it out.
        again = json.loads(second.spikectl("push", file, "--policy=acrobot", "--rollout=5%,50%", "--json").stdout)
        assert (again["version"], again["existed"], again["rollout"]["state"]) == (2, True, "running")
        assert again["rollout"]["steps"] == [5, 50]
        assert code_of(third.admin.RemovePolicy, policy="acrobot", version=2) == grpc.StatusCode.FAILED_PRECONDITION
        third.spikectl("admin", "rollout", "--policy=acrobot", "--abort")
        # A server that is away meanwhile does not serve it when it comes back, and nothing remains in Redis.
        second.kill()
        third.spikectl("rm", "--policy=acrobot", "--version=2")
        second.restart()
        for replica in replicas:
            until(lambda replica=replica: versions(replica) == [1])
        assert not (third.policies / "acrobot/2").exists()
        until(lambda: not (first.policies / "acrobot/2").exists())
        assert sorted(key for key in redis.command("KEYS pf:*") if key != b"pf:servers") == [
            key for key in keys if key != b"pf:servers"
        ]
        until(lambda: redis.command("HEXISTS pf:versions acrobot@2") == 0)
        # Its number is not used again.
        assert push(first, make(3)).version == 3
        assert code_of(push, first, make(4), version=2) == grpc.StatusCode.ALREADY_EXISTS
        # No number follows the largest one.
        assert push(first, make(4), version=2**63 - 1).version == 2**63 - 1
        assert code_of(push, first, make(5)) == grpc.StatusCode.ALREADY_EXISTS
        until(lambda: versions(second) == [1, 3, 2**63 - 1])


@WITHOUT_REDIS
def test_redis_that_lost_everything_gets_the_files_again(tmp_path, make):
    with fleet(tmp_path, count=2) as (redis, (first, second)):
        push(first, make(2), make_default=True)
        until(lambda: versions(second) == [1, 2])
        second.kill()
        shutil.rmtree(second.policies / "acrobot/2")
        redis.command("FLUSHALL")
        until(lambda: redis.command("HGET cfg revision") is not None)
        second.restart()
        assert (versions(second), default(second)) == ([1, 2], 2)
        assert pull(second, 2) == make(2)


def refused_files(data, folder):
    yield data[:-1]
    yield b""
    floats = (RELEASED_POLICIES / "cartpole-sparse/1/policy.safetensors").read_bytes()
    yield floats[:-4] + b"\xff\xff\xff\xff"  # the last number is not finite
    tensors, metadata = read_policy(ACROBOT)
    for tensor in tensors.values():
        if tensor.dtype != np.float32:
            tensor[...] = np.iinfo(tensor.dtype).max  # sums of 32 bits could overflow
    write_policy(folder / "large/policy.safetensors", tensors, metadata)
    yield (folder / "large/policy.safetensors").read_bytes()


def half(request, data, held):
    """Yields a part of a push, and no more until `held` is set."""
    yield request(policy="acrobot", sha256=sha256(data))
    yield request(data=[data[:PART]])
    held.wait()


def test_what_is_refused_leaves_nothing(folder, tokens, make):
    data = make(2)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    with running_server(folder, [f"--tokens={tokens}", f"--max_policy_bytes={size + LENGTH // 2}"]) as server:
        before = contents(folder)
        small = (SHIPPED_POLICIES / "cartpole-small/1/policy.safetensors").read_bytes()

        def refused(code, part, content=data, token="operator", **fields):
            with fails_with(code, part):
                push(server, content, token, **fields)
            assert contents(folder) == before

        invalid, denied = (grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.PERMISSION_DENIED)
        for content in refused_files(data, folder / ".."):
            refused(invalid, "data: ", content)
        refused(invalid, f"sha256: expected that of the data, {sha256(data)}, received", sha256="0" * 64)
        refused(invalid, "signature: expected at most 65536 bytes, received 65537", signature=b"{" * 65537)
        refused(invalid, "policy: expected a name of at most 128 letters", policy="../x")
        refused(invalid, "version: expected at least 0, received -1", version=-1)
        refused(grpc.StatusCode.ALREADY_EXISTS, "the next one is 2", small, version=1)
        refused(denied, "role: expected operator, received agent", token="agent")
        refused(denied, "tenant: expected that of the token", tenant="rival")
        refused(grpc.StatusCode.RESOURCE_EXHAUSTED, "--max_policy_bytes: expected room")
        # A call that the client gives up.
        request, call = method_of(server.channel, ADMIN, "PushPolicy")
        held = threading.Event()
        stream = call.future(half(request, data, held), metadata=[("authorization", "Bearer operator")])
        stream.cancel()
        held.set()
        assert contents(folder) == before
        # Who did what is recorded, without the bytes.
        operator = Service(server.channel, ADMIN, grpc.intercept_channel(server.channel, Bearer("operator")))
        entries = [each for each in operator.ListHistory().entries if each.action == "PushPolicy"]
        assert any("--max_policy_bytes" in each.message for each in entries)
        assert all(json.loads(each.request)["data"] == [] for each in entries)


def test_a_push_is_bounded(folder, make):
    with running_server(folder, [f"--max_tenant_bytes={LENGTH // 2}"]) as server:
        before = contents(folder)
        with fails_with(grpc.StatusCode.RESOURCE_EXHAUSTED, "--max_tenant_bytes"):
            push(server, make(2))
        assert contents(folder) == before
        decide(server, 1)


def sign(keys, text):
    (keys / "text").write_bytes(text)
    openssl("pkeyutl", "-sign", "-rawin", "-inkey", "alice.key", "-in", "text", "-out", "signature", cwd=keys)
    return (keys / "signature").read_bytes()


@WITHOUT_REDIS
def test_signatures_are_for_a_name_and_a_number(tmp_path, make):
    keys = tmp_path / "keys"
    keys.mkdir()
    openssl("genpkey", "-algorithm", "ed25519", "-out", "alice.key", cwd=keys)
    openssl("pkey", "-in", "alice.key", "-pubout", "-out", "alice.pem", cwd=keys)
    data = make(2)
    statement = f"spikeserve policy acrobot 2 {sha256(data)}\n"
    with fleet(tmp_path, f"--trusted_keys={keys}/alice.pem", "--allow_no_policies", count=2) as (_, replicas):
        first, second = replicas
        invalid = grpc.StatusCode.INVALID_ARGUMENT
        for signature in (
            b"",
            sign(keys, data),  # of the content alone
            sign(keys, statement.replace(" 2 ", " 3 ").encode()),
            sign(keys, statement.replace("acrobot", "other").encode()),
        ):
            assert code_of(push, first, data, version=2, signature=signature) == invalid
        good = sign(keys, statement.encode())
        assert code_of(push, first, data, version=3, signature=good) == invalid
        assert push(first, data, version=2, signature=good).version == 2
        until(lambda: versions(second) == [2])  # which has checked it, too
        assert second.admin.PullPolicy(policy="acrobot", version=2).signature == good
        first.restart()
        assert versions(first) == [2]
        # In another folder the signature does not hold.
        shutil.copytree(first.policies / "acrobot/2", first.policies / "acrobot/4")
        [refusal] = [line for line in first.admin.ReloadPolicies().refused if "acrobot/4" in line]
        assert "received one of another file or key" in refusal


def push_and_kill(server, data, position, delay):
    """Kills the server when `position` bytes of the file are sent, or `delay` seconds after all of them."""

    def sent(count):
        if position < len(data) and count >= position:
            server.kill()
        elif count == len(data):
            threading.Timer(delay, server.kill).start()

    # Parts of odd lengths, so that a position is anywhere.
    code_of(push, server, data, sent=sent, part=PART + position % 97, make_default=True)
    server.kill()


def check_old_or_new(server, old, new):
    """Asserts that the server serves all of the old state or all of the new one. Returns the version."""
    number = versions(server)[-1]
    assert number in (old[0], new[0])
    assert default(server) == number, "the version without what was asked with it"
    assert pull(server, number) == (old if number == old[0] else new)[1]
    decide(server, number)
    assert server.admin.ReloadPolicies().refused == []
    return number


@WITHOUT_REDIS
@pytest.mark.parametrize("shared", [True, False], ids=["Redis", "folder"])
def test_a_push_that_kill_ends_is_there_or_not(tmp_path, folder, make, shared):
    chance = random.Random(1)
    settings = [f"--policy_settings={tmp_path}/settings.json"]
    with contextlib.ExitStack() as stack:
        if shared:
            _, (server, other) = stack.enter_context(fleet(tmp_path, count=2))
        else:
            server = stack.enter_context(Restartable("memory", settings, folder))
        start = time.monotonic()
        old = (push(server, make(1), make_default=True).version, make(1))
        storing = time.monotonic() - start
        ends = []
        for i in range(KILLS):
            data = make(i + 2)
            position = chance.randrange(2 * len(data))
            push_and_kill(server, data, position, delay=chance.uniform(0, 2 * storing))
            server.restart()
            number = versions(server)[-1]
            if not shared and number != old[0] and default(server) == old[0]:
                # Without a store the file is there before it is the default, which is the next change.
                server.admin.SetDefaultVersion(policy="acrobot", version=number)
            number = check_old_or_new(server, old, (number, data))
            ends.append("old" if number == old[0] else "new")
            if shared:
                until(lambda: versions(other) == versions(server))
                assert pull(other, number) == pull(server, number)
            assert not [name for name in contents(server.policies) if ".unfinished" in name]
            old = (number, pull(server, number))
        print(f"of {len(ends)} pushes that kill -9 ended, {ends.count('new')} were there afterwards")
        assert "old" in ends


def test_the_oldest_versions_that_nothing_uses_make_room(folder, make):
    with running_server(folder, ["--max_pushed_versions=2"]) as server:
        assert [push(server, make(seed)).version for seed in (2, 3)] == [2, 3]
        session = server.agent.OpenSession(policy="acrobot", version=2).session_id
        pushed = push(server, make(4), make_default=True)
        assert (pushed.version, list(pushed.removed)) == (4, [3])  # the older one has a session
        assert versions(server) == [1, 2, 4]
        assert not (folder / "acrobot/3").exists()
        with fails_with(grpc.StatusCode.RESOURCE_EXHAUSTED, "--max_pushed_versions: expected fewer than 2 versions"):
            push(server, make(5))
        server.agent.CloseSession(session_id=session)
        assert list(push(server, make(5)).removed) == [2]
        # Versions of the operator's own files are not removed, not even when asked to.
        assert versions(server) == [1, 4, 5]
        with fails_with(grpc.StatusCode.FAILED_PRECONDITION, "whose file an operator has written"):
            server.admin.RemovePolicy(policy="acrobot", version=1)
        server.admin.RemovePolicy(policy="acrobot", version=5)
        assert push(server, make(6), policy="new").version == 1
        server.admin.RemovePolicy(policy="new", version=1)
        assert not (folder / "new").exists()
