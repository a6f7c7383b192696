"""Servers with --trusted_keys serve only policies that one of these keys has signed."""

import contextlib
import os
import shutil

import grpc
import pytest
from documentation import Shell
from redis_servers import PASSWORD, WITHOUT_REDIS, Redis, stopping
from security import code_of, fails_with, openssl, until
from serving import SHIPPED_POLICIES, refusal_at_start, running_server
from stored_sessions import learn

SIGNATURE_BYTES = 64
LONG_AGO = 1_000_000_000


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    """Makes the keys alice, bob and mallory, and returns their folder. trusted.pem holds those of alice and bob."""
    path = tmp_path_factory.mktemp("keys")
    for name in ("alice", "bob", "mallory"):
        openssl("genpkey", "-algorithm", "ed25519", "-out", f"{name}.key", cwd=path)
        openssl("pkey", "-in", f"{name}.key", "-pubout", "-out", f"{name}.pem", cwd=path)
    (path / "trusted.pem").write_text((path / "alice.pem").read_text() + (path / "bob.pem").read_text())
    return path


def copy_cartpole(folder):
    for version in ("1", "2"):
        shutil.copytree(SHIPPED_POLICIES / "cartpole" / version, folder / "cartpole" / version)


@pytest.fixture
def folder(tmp_path):
    """Returns a policy directory with two versions of cartpole, without signatures."""
    copy_cartpole(tmp_path / "policies")
    return tmp_path / "policies"


def policy_file(folder, version=1):
    return folder / f"cartpole/{version}/policy.safetensors"


def signature_file(folder, version=1):
    return folder / f"cartpole/{version}/policy.safetensors.sig"


def sign(keys, folder, version=1, key="alice"):
    names = ("-in", "policy.safetensors", "-out", "policy.safetensors.sig")
    key_file = ("-inkey", keys / f"{key}.key")
    openssl("pkeyutl", "-sign", "-rawin", *key_file, *names, cwd=policy_file(folder, version).parent)


def trusting(keys, *flags):
    return [f"--trusted_keys={keys}/trusted.pem", *flags]


def served(service):
    return [policy.version for policy in service.ListPolicies().policies if policy.name == "cartpole"]


@contextlib.contextmanager
def services(folder, flags, log=None):
    with running_server(folder, flags, log=log) as addresses:
        yield addresses.agent, addresses.admin


def test_versions_that_any_trusted_key_has_signed_are_served(keys, folder):
    sign(keys, folder, 1, "alice")
    sign(keys, folder, 2, "bob")
    with services(folder, trusting(keys)) as (service, admin):
        assert served(service) == [1, 2]
        assert admin.ReloadPolicies().refused == []
        session = service.OpenSession(policy="cartpole").session_id
        service.Act(session_id=session, observation=[0.0] * 4)


def unsigned(keys, folder):
    signature_file(folder).unlink()
    return "expected a signature in policy.safetensors.sig, because of --trusted_keys, received none"


def changed_policy(keys, folder):
    content = bytearray(policy_file(folder).read_bytes())
    content[-1] ^= 1
    policy_file(folder).write_bytes(content)
    return "received one of another file or key"


def changed_signature(keys, folder):
    signature = bytearray(signature_file(folder).read_bytes())
    signature[10] ^= 1
    signature_file(folder).write_bytes(signature)
    return "received one of another file or key"


def signature_of_another_file(keys, folder):
    shutil.copy(signature_file(folder, 2), signature_file(folder, 1))
    return "received one of another file or key"


def another_key(keys, folder):
    sign(keys, folder, 1, "mallory")
    return "expected the signature of this policy file by one of the 2 keys of --trusted_keys"


def short_signature(keys, folder):
    signature_file(folder).write_bytes(signature_file(folder).read_bytes()[:-1])
    return "policy.safetensors.sig: expected the 64 bytes of an Ed25519 signature, received 63 bytes"


def long_signature(keys, folder):
    signature_file(folder).write_bytes(signature_file(folder).read_bytes() + b"\n")
    return "policy.safetensors.sig: expected the 64 bytes of an Ed25519 signature, received more"


def pipe(keys, folder):
    signature_file(folder).unlink()
    os.mkfifo(signature_file(folder))
    return "policy.safetensors.sig: expected a file that can be read"


BREAK = [
    unsigned,
    changed_policy,
    changed_signature,
    signature_of_another_file,
    another_key,
    short_signature,
    long_signature,
    pipe,
]


@pytest.mark.parametrize("damage", BREAK)
def test_a_version_is_refused_at_the_start(keys, folder, tmp_path, damage):
    sign(keys, folder, 1)
    sign(keys, folder, 2)
    reason = damage(keys, folder)
    log = tmp_path / "log"
    with services(folder, trusting(keys), log) as (service, _):
        assert served(service) == [2]
    logged = log.read_text()
    assert str(policy_file(folder)) in logged
    assert reason in logged
    # Without any other version the server does not start.
    shutil.rmtree(folder / "cartpole/2")
    said = refusal_at_start(*trusting(keys), policies=folder)
    assert str(policy_file(folder)) in said
    assert reason in said


@pytest.mark.parametrize("damage", BREAK)
def test_a_version_is_refused_by_reload_and_load(keys, folder, damage):
    sign(keys, folder, 1)
    sign(keys, folder, 2)
    good = policy_file(folder).read_bytes()
    with services(folder, trusting(keys)) as (service, admin):
        reason = damage(keys, folder)
        [refused] = admin.ReloadPolicies().refused
        assert refused.startswith(str(policy_file(folder)))
        assert reason in refused
        with fails_with(grpc.StatusCode.INVALID_ARGUMENT, whole=refused):
            admin.LoadPolicy(policy="cartpole", version=1)
        assert served(service) == [1, 2]  # the version that was loaded before stays
        signature_file(folder).unlink(missing_ok=True)
        policy_file(folder).write_bytes(good)
        sign(keys, folder)
        assert admin.ReloadPolicies().refused == []


def test_the_poller_waits_for_the_signature(keys, folder, tmp_path):
    sign(keys, folder, 1)
    log = tmp_path / "log"
    with services(folder, trusting(keys, "--poll_policies=10ms"), log) as (service, _):
        until(lambda: "cartpole/2/policy.safetensors: expected a signature" in log.read_text())
        assert served(service) == [1]
        sign(keys, folder, 2, "mallory")
        until(lambda: "received one of another file or key" in log.read_text())
        assert served(service) == [1]
        sign(keys, folder, 2, "bob")
        until(lambda: served(service) == [1, 2])


def test_old_signatures_are_not_swept(keys, folder):
    """At the start the server removes old temporary files, whose names are similar."""
    sign(keys, folder, 1)
    os.utime(signature_file(folder), (LONG_AGO, LONG_AGO))
    for _ in range(2):
        with services(folder, trusting(keys)) as (service, _):
            assert served(service) == [1]


def test_promotion_without_a_signing_key_is_refused(keys, folder):
    for version in (1, 2):
        sign(keys, folder, version)
    with services(folder, trusting(keys)) as (service, admin):
        learn(service)
        with fails_with(grpc.StatusCode.FAILED_PRECONDITION) as error:
            admin.PromoteHead(policy="cartpole")
    assert error.value.details() == (
        "--signing_key: expected the key that signs promoted versions, because --trusted_keys refuses versions "
        "without a signature, received none"
    )
    assert sorted(path.name for path in (folder / "cartpole").iterdir()) == ["1", "2"]


def test_a_promoted_version_is_signed(keys, folder):
    for version in (1, 2):
        sign(keys, folder, version)
    with services(folder, trusting(keys, f"--signing_key={keys}/bob.key")) as (service, admin):
        learn(service)
        assert admin.PromoteHead(policy="cartpole").version == 3
        assert served(service) == [1, 2, 3]
    assert signature_file(folder, 3).stat().st_size == SIGNATURE_BYTES
    files = ("-in", policy_file(folder, 3), "-sigfile", signature_file(folder, 3))
    openssl("pkeyutl", "-verify", "-rawin", "-pubin", "-inkey", "bob.pem", *files, cwd=keys)
    with services(folder, trusting(keys)) as (service, _):  # after a restart, too
        assert served(service) == [1, 2, 3]


def rsa_key(keys, path):
    openssl("genpkey", "-algorithm", "rsa", "-out", "rsa.key", cwd=path)
    openssl("pkey", "-in", "rsa.key", "-pubout", "-out", "rsa.pem", cwd=path)
    return (keys / "alice.pem").read_text() + (path / "rsa.pem").read_text()


BAD_TRUSTED_KEYS = [
    (lambda keys, _: "", "expected Ed25519 public keys in PEM, received none"),
    (lambda keys, _: "no key\n", "expected Ed25519 public keys in PEM, received none"),
    (lambda keys, _: (keys / "alice.pem").read_text()[:60], "expected PEM, received a block that cannot be read"),
    (lambda keys, _: (keys / "alice.key").read_text(), "expected only blocks PUBLIC KEY, received a block PRIVATE KEY"),
    (rsa_key, "expected an Ed25519 key, received a key of type RSA"),
    (
        lambda keys, _: "-----BEGIN PUBLIC KEY-----\nAAAA\n-----END PUBLIC KEY-----\n",
        "expected an Ed25519 key, received a block that is no key",
    ),
]


@pytest.mark.parametrize(("content", "reason"), BAD_TRUSTED_KEYS)
def test_a_bad_file_of_trusted_keys(keys, folder, tmp_path, content, reason):
    path = tmp_path / "bad.pem"
    path.write_text(content(keys, tmp_path))
    assert f"--trusted_keys: {path}: {reason}" in refusal_at_start(f"--trusted_keys={path}", policies=folder)


def test_a_missing_file_of_trusted_keys(folder, tmp_path):
    said = refusal_at_start(f"--trusted_keys={tmp_path}/missing.pem", policies=folder)
    assert f"--trusted_keys: {tmp_path}/missing.pem: expected a file that can be read" in said


def test_a_signing_key_must_be_trusted(keys, folder):
    said = refusal_at_start(*trusting(keys, f"--signing_key={keys}/mallory.key"), policies=folder)
    assert f"--signing_key: {keys}/mallory.key: expected the private key of one of the keys in" in said
    said = refusal_at_start(*trusting(keys, f"--signing_key={keys}/alice.pem"), policies=folder)
    assert f"{keys}/alice.pem: expected one block PRIVATE KEY, without a password, received a block PUBLIC KEY" in said
    said = refusal_at_start(f"--signing_key={keys}/alice.key", policies=folder)
    assert "--signing_key: expected --trusted_keys, too, received none" in said


@contextlib.contextmanager
def replica(redis, keys, folder, *flags, log=None):
    password = folder.parent / "password"
    password.write_text(PASSWORD)
    store = [f"--session_store=redis://127.0.0.1:{redis.port}", f"--store_password_file={password}"]
    with services(folder, [*store, *flags], log) as both:
        yield both


@WITHOUT_REDIS
def test_promoted_versions_of_other_servers(keys, folder, tmp_path):
    """A version that another server has promoted is taken over with its signature, and refused without one."""
    for version in (1, 2):
        sign(keys, folder, version)
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    signing, log = f"--signing_key={keys}/alice.key", tmp_path / "log"
    with (
        stopping([Redis()]) as [redis],
        replica(redis, keys, folder, *trusting(keys, signing)) as (first, first_admin),
        replica(redis, keys, other, *trusting(keys), log=log) as (second, _),
    ):
        learn(first)
        assert first_admin.PromoteHead(policy="cartpole").version == 3
        until(lambda: served(second) == [1, 2, 3])
        assert signature_file(other, 3).read_bytes() == signature_file(folder, 3).read_bytes()

        third = tmp_path / "third"
        copy_cartpole(third)
        with replica(redis, keys, third) as (unguarded, unguarded_admin):  # trusts everything and signs nothing
            until(lambda: served(unguarded) == [1, 2, 3])
            learn(unguarded, seed=2)  # other actions, so that the new version has other bytes
            assert unguarded_admin.PromoteHead(policy="cartpole").version == 4
        until(lambda: "promoted version not taken over" in log.read_text())
    refusal = "promoted version in the session store: expected a signature in policy.safetensors.sig"
    assert f"{policy_file(other, 4)}: {refusal}" in log.read_text()
    assert not policy_file(other, 4).exists()


def test_the_page(tmp_path):
    """The commands of the page work as printed."""
    with Shell(tmp_path) as shell:
        *_, refused, signed, pushed = shell.run("signing.md")
    assert "expected a signature in policy.safetensors.sig" in refused
    assert signed.startswith("loaded 1, unloaded 0\n")
    assert signed.endswith("Signature Verified Successfully\n")
    assert pushed.startswith("pushed cartpole/3")


def test_codes_of_loading(keys, folder):
    """A version without a file is NOT_FOUND, with signatures as without."""
    sign(keys, folder, 1)
    with services(folder, trusting(keys)) as (_, admin):
        assert code_of(admin.LoadPolicy, policy="cartpole", version=9) == grpc.StatusCode.NOT_FOUND
        assert code_of(admin.LoadPolicy, policy="cartpole", version=2) == grpc.StatusCode.INVALID_ARGUMENT
