"""A policy that cannot be served is refused with its path and the reason, and the others are served."""

import json
import shutil

import grpc
import pytest
from made_policies import LARGEST
from policy_file import read_policy, write_policy
from security import OBSERVATION, code_of
from serving import RELEASED_POLICIES, SHIPPED_POLICIES, add_version, refusal_at_start, running_server

GOOD = (RELEASED_POLICIES / "cartpole-sparse/1/policy.safetensors").read_bytes()
NAN = b"\0\0\xc0\x7f"


@pytest.fixture
def policies(tmp_path):
    """Makes a folder with two versions of cartpole and one of pendulum."""
    folder = tmp_path / "policies"
    for version in (1, 2):
        add_version(folder, "cartpole", version, SHIPPED_POLICIES / "cartpole-small/1")
    add_version(folder, "pendulum", 1, SHIPPED_POLICIES / "pendulum/1")
    return folder


def write(policies, version, content):
    """Writes the file of a version of `bad`, or of another policy. Returns its path."""
    path = policies / version / "policy.safetensors"
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    return path


def log_of(policies, *flags):
    """Starts and ends a server that serves the three good versions. Returns its log."""
    log = policies.parent / "log"
    with running_server(policies, flags, log=log) as server:
        served = [(policy.name, policy.version) for policy in server.agent.ListPolicies().policies]
        assert served == [("cartpole", 1), ("cartpole", 2), ("pendulum", 1)]
    return log.read_text()


def assert_refused(policies, path, reason):
    line = log_of(policies)
    assert f' warning policy refused error="{path}: ' in line
    assert reason in line
    assert line.count("\n") == 1, line


BAD = {
    "truncated": (GOOD[: len(GOOD) // 2], "data_offsets"),
    "garbage": (b"this is not a policy", "header"),
    "not_a_number": (GOOD[:-4] + NAN, "finite"),
    "empty": (b"", "bytes"),
}


@pytest.mark.parametrize(("content", "reason"), BAD.values(), ids=BAD)
def test_a_bad_file_is_refused(policies, content, reason):
    assert_refused(policies, write(policies, "bad/1", content), reason)


def test_a_policy_that_decides_nothing_finite_is_refused(policies):
    """All numbers in the file are finite; only a decision shows that the policy computes others."""
    tensors, metadata = read_policy(SHIPPED_POLICIES / "cartpole/1/policy.safetensors")
    tensors["head.weight"][:] = LARGEST
    path = policies / "bad/1/policy.safetensors"
    write_policy(path, tensors, metadata)
    assert_refused(policies, path, "expected a finite first decision")


def test_a_missing_file_is_refused(policies):
    path = policies / "bad/1/policy.safetensors"
    path.parent.mkdir(parents=True)
    path.with_name("notes.txt").write_text("an empty folder would be ignored")
    assert_refused(policies, path, "no such file")


@pytest.mark.parametrize("version", ["latest", "0", "-1", "01", "1.5"])
def test_versions_are_positive_integers(policies, version):
    path = write(policies, f"cartpole/{version}", GOOD)
    assert_refused(policies, path.parent, "expected a version, a positive integer")


def test_versions_order_as_numbers_and_a_bad_one_is_no_default(policies):
    add_version(policies, "cartpole", 10)
    add_version(policies, "cartpole", 9)
    write(policies, "cartpole/11", b"garbage")
    with running_server(policies) as server:
        assert server.agent.OpenSession(policy="cartpole").version == 10


def test_the_log_is_json_if_asked_for(policies):
    path = write(policies, "bad/1", b"this is not a policy")
    line = json.loads(log_of(policies, "--log_format=json"))
    assert (line["level"], line["message"]) == ("warning", "policy refused")
    assert str(path) in line["error"]


def test_nothing_to_serve_stops_the_start_with_what_to_do(tmp_path):
    refusal = refusal_at_start(policies=tmp_path)
    assert f"--policies: {tmp_path}: expected <policy>/<version>/policy.safetensors" in refusal
    assert "the directory has no policies" in refusal and "--allow_no_policies" in refusal
    path = write(tmp_path, "bad/1", b"")
    assert str(path) in refusal_at_start(policies=tmp_path)


def test_a_directory_of_the_wrong_level_names_the_right_one(policies):
    right = f"use --policies={policies}."
    for folder, what in (("cartpole", "one policy"), ("cartpole/", "one policy"), ("cartpole/1", "one version")):
        refusal = refusal_at_start(policies=f"{policies}/{folder}")
        assert f"the folder of {what}" in refusal and right in refusal
    shutil.rmtree(policies / "cartpole")
    refusal = refusal_at_start(policies=policies.parent)
    assert "a directory above the policies" in refusal and right.rstrip(".") in refusal


def test_nothing_is_served_if_that_is_meant(tmp_path):
    policies = tmp_path / "policies"
    policies.mkdir()
    log = tmp_path / "log"
    with running_server(policies, ["--allow_no_policies"], log=log):
        pass
    assert "no policy is served" in log.read_text() and str(policies) in log.read_text()


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
def linked_policies(tmp_path, outside):
    path = tmp_path / "linked_policies"
    shutil.copytree(SHIPPED_POLICIES / "cartpole" / "1", path / "cartpole" / "1")
    # Links that lead out: a policy, a version, a file.
    (path / "linked").symlink_to(outside / "secret")
    (path / "cartpole" / "2").symlink_to(outside / "secret" / "7")
    (path / "cartpole" / "3").mkdir()
    (path / "cartpole" / "3" / "policy.safetensors").symlink_to("../../../outside/secret/7/policy.safetensors")
    # A link within the directory, as Kubernetes mounts them.
    (path / "cartpole" / "4").symlink_to("1")
    return path


def test_links_that_lead_out_are_refused(linked_policies, outside, tmp_path):
    beside = tmp_path / "mounted"
    beside.symlink_to(linked_policies)
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


def test_a_promoted_head_is_not_written_elsewhere(linked_policies, outside):
    with running_server(linked_policies) as addresses:
        learning = {"scope": "FLEET"}
        session = addresses.agent.OpenSession(policy="cartpole", version=1, learning=learning).session_id
        for step in range(5):
            addresses.agent.Act(session_id=session, step=step, observation=OBSERVATION, reward=float(step))
        addresses.agent.EndEpisode(session_id=session, reward=9.0, terminated=True)
        assert addresses.admin.GetHead(policy="cartpole", version=1).drift > 0
        (linked_policies / "cartpole").rename(outside / "cartpole")
        before = sorted(path.name for path in (outside / "cartpole").iterdir())
        (linked_policies / "cartpole").symlink_to(outside / "cartpole")
        assert code_of(addresses.admin.PromoteHead, policy="cartpole", version=1) == REFUSED
        assert sorted(path.name for path in (outside / "cartpole").iterdir()) == before
