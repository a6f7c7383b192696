"""A symbolic link in the policy directory does not lead out of it."""

import shutil

import grpc
import pytest
from security import OBSERVATION, code_of
from serving import SHIPPED_POLICIES, running_server

REFUSED = grpc.StatusCode.INVALID_ARGUMENT


@pytest.fixture
def outside(tmp_path):
    """Returns a directory with the policy `secret/7`, beside the policy directory."""
    path = tmp_path / "outside"
    shutil.copytree(SHIPPED_POLICIES / "cartpole" / "1", path / "secret" / "7")
    (path / "secret" / "private-name").mkdir()
    (path / "secret" / ".unfinished-other").mkdir()
    return path


@pytest.fixture
def policies(tmp_path, outside):
    path = tmp_path / "policies"
    shutil.copytree(SHIPPED_POLICIES / "cartpole" / "1", path / "cartpole" / "1")
    # Links that lead out: a policy, a version, a file.
    (path / "linked").symlink_to(outside / "secret")
    (path / "cartpole" / "2").symlink_to(outside / "secret" / "7")
    (path / "cartpole" / "3").mkdir()
    (path / "cartpole" / "3" / "policy.safetensors").symlink_to("../../../outside/secret/7/policy.safetensors")
    # A link within the directory, as Kubernetes mounts them.
    (path / "cartpole" / "4").symlink_to("1")
    return path


def test_links_that_lead_out_are_refused(policies, outside, tmp_path):
    beside = tmp_path / "mounted"
    beside.symlink_to(policies)
    with running_server(beside) as addresses:
        served = {(policy.name, policy.version) for policy in addresses.agent.ListPolicies().policies}
        assert served == {("cartpole", 1), ("cartpole", 4)}
        refused = " ".join(addresses.admin.ReloadPolicies().refused)
        for name in ("linked", "cartpole/2", "cartpole/3/policy.safetensors"):
            assert f"{beside}/{name}: expected a file within {beside}, received a symbolic link" in refused
        assert "private-name" not in refused
        for version in (2, 3):
            assert code_of(addresses.admin.LoadPolicy, policy="cartpole", version=version) == REFUSED
        assert code_of(addresses.admin.LoadPolicy, policy="linked", version=7) == REFUSED
    assert (outside / "secret" / ".unfinished-other").is_dir()


def test_a_promoted_head_is_not_written_elsewhere(policies, outside):
    with running_server(policies) as addresses:
        learning = {"scope": "FLEET"}
        session = addresses.agent.OpenSession(policy="cartpole", version=1, learning=learning).session_id
        for step in range(5):
            addresses.agent.Act(session_id=session, step=step, observation=OBSERVATION, reward=float(step))
        addresses.agent.EndEpisode(session_id=session, reward=9.0, terminated=True)
        assert addresses.admin.GetHead(policy="cartpole", version=1).drift > 0
        (policies / "cartpole").rename(outside / "cartpole")
        before = sorted(path.name for path in (outside / "cartpole").iterdir())
        (policies / "cartpole").symlink_to(outside / "cartpole")
        assert code_of(addresses.admin.PromoteHead, policy="cartpole", version=1) == REFUSED
        assert sorted(path.name for path in (outside / "cartpole").iterdir()) == before
