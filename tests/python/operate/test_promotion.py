"""Promotions: many in a row, on a full disk, and killed in the middle."""

import contextlib
import json
import os
import subprocess
import threading
import time

import grpc
import gymnasium
import pytest
from policy_file import read_policy
from random_policy import export_random
from security import ADMIN, POLICY, Bearer, code_of, until
from serving import Service, page_of, running_server

PROMOTIONS = 1000
LONGEST_FILE = 4096  # bytes; shorter than a policy
OLD_SECONDS = 3600


@pytest.fixture
def folder(tmp_path):
    export_random(tmp_path, "small", gymnasium.make("CartPole-v1"))
    return tmp_path


class Trainer:
    """Teaches the shared head of a version, and promotes it."""

    def __init__(self, server, *tokens):
        self._policy, self.admin = server.agent, server.admin
        if tokens:
            agent, operator = [grpc.intercept_channel(server.channel, Bearer(token)) for token in tokens]
            self._policy = Service(server.channel, POLICY, agent)
            self.admin = Service(server.channel, ADMIN, operator)

    def teach(self, version):
        session = self._policy.OpenSession(
            policy="small", version=version, action_selection="SAMPLE", learning={"scope": "FLEET"}
        ).session_id
        for step, reward in enumerate([0.0, 1.0, -3.0]):
            self._policy.Act(session_id=session, step=step, observation=[0.1] * 4, reward=reward)
        self._policy.EndEpisode(session_id=session, reward=2.0, terminated=True)
        self._policy.CloseSession(session_id=session)

    def promote(self, version):
        self.teach(version)
        return self.admin.PromoteHead(policy="small", version=version, make_default=True)


def contents(folder):
    """Returns the paths of everything in the folder of the policy."""
    return sorted(str(path.relative_to(folder)) for path in (folder / "small").rglob("*"))


def test_many_promotions_in_a_row(folder):
    with running_server(folder) as addresses:
        trainer = Trainer(addresses)
        version = 1
        for _ in range(PROMOTIONS):
            promoted = trainer.promote(version)
            assert promoted.version == version + 1
            version = promoted.version
            trainer.admin.UnloadPolicy(policy="small", version=version - 1)
    first = json.loads(read_policy(folder / "small/2/policy.safetensors")[1]["training"])
    last = json.loads(read_policy(folder / f"small/{version}/policy.safetensors")[1]["training"])
    assert last["promoted"]["parent_version"] == version - 1
    assert last["promoted"]["promotions"] == PROMOTIONS
    assert last["parent_training"] == first["parent_training"]


def test_a_tenant_leaves_others_room_for_their_versions(folder, tokens):
    """Six files fit: the one that is there, three of one tenant, one of the other."""
    size = (folder / "small/1/policy.safetensors").stat().st_size + 1000  # of the lineage
    flags = [f"--tokens={tokens}", f"--max_policy_bytes={7 * size}"]
    full = grpc.StatusCode.RESOURCE_EXHAUSTED
    with running_server(folder, flags) as addresses:
        greedy = Trainer(addresses, "agent", "operator")
        neighbour = Trainer(addresses, "rival", "rival-operator")
        promoted = 0
        while code_of(greedy.promote, 1) != full:
            promoted += 1
        assert promoted == 3
        before = contents(folder)
        assert code_of(greedy.promote, 1) == full
        assert contents(folder) == before
        assert neighbour.promote(1).version == 5
        stored = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        page = page_of(addresses, "/metrics", "viewer")
        assert f'spikeserve_stored_bytes{{folder="policies"}} {stored}' in page
        assert f'spikeserve_stored_bytes_limit{{folder="policies"}} {7 * size}' in page


def test_a_promotion_on_a_full_disk_is_an_error_and_leaves_nothing(folder):
    before = contents(folder)
    with running_server(folder, prefix=["prlimit", f"--fsize={LONGEST_FILE}:"]) as addresses:
        trainer = Trainer(addresses)
        with pytest.raises(grpc.RpcError) as error:
            trainer.promote(1)
        assert "policy.safetensors: cannot write" in error.value.details()
        assert contents(folder) == before
        assert trainer.admin.ReloadPolicies().refused == []
        # With room again, the same head is promoted.
        unlimited = "--fsize=unlimited:"
        subprocess.run(["prlimit", f"--pid={addresses.process.pid}", unlimited], check=True)
        assert trainer.admin.PromoteHead(policy="small", version=1).version == 2
        assert trainer.admin.ReloadPolicies().refused == []


def age(path):
    """Makes a file look as if it had been written an hour ago."""
    then = time.time() - OLD_SECONDS
    os.utime(path, (then, then))


def test_what_killed_promotions_have_left_is_swept_at_the_start(folder):
    before = contents(folder)
    small = folder / "small"
    for name in (".unfinished-abcdef", "2", "3"):
        (small / name).mkdir()
    for name in (".unfinished-abcdef/policy.safetensors.Xy12Zz", "3/policy.safetensors.Ab34Cd"):
        (small / name).write_bytes(b"part of a policy")
        age(small / name)
    with running_server(folder) as addresses:
        assert contents(folder) == before
        (small / "4").mkdir()  # appears later: ignored until it has a file
        assert addresses.admin.ReloadPolicies().refused == []


def promote_until_killed(admin):
    with contextlib.suppress(grpc.RpcError):
        while True:
            admin.PromoteHead(policy="small", version=1)


def test_a_server_killed_while_it_promotes_leaves_whole_versions_only(folder):
    with running_server(folder) as addresses:
        trainer = Trainer(addresses)
        trainer.teach(1)
        thread = threading.Thread(target=promote_until_killed, args=[trainer.admin])
        thread.start()
        until(lambda: sum(name.isdigit() for name in os.listdir(folder / "small")) > 6)
        addresses.kill()
        thread.join()
    with running_server(folder) as addresses:
        assert addresses.admin.ReloadPolicies().refused == []
        served = addresses.agent.ListPolicies().policies
    versions = [f"{policy.version}" for policy in served]
    files = [f"{version}/policy.safetensors" for version in versions]
    assert contents(folder) == sorted(f"small/{path}" for path in versions + files)
    assert len(versions) > 5
