"""The image of deploy/image/Dockerfile, built without a daemon: its size, its files, and the server as process 1.

The image is made from Debian packages of this build (--build-arg SOURCE=packages), on a base image from debootstrap.
Needs root, debootstrap, buildah and a mirror of Debian; is skipped without them.
"""

import contextlib
import json
import os
import pathlib
import shutil
import signal
import subprocess

import grpc
import pytest
from serving import DEADLINE_SECONDS, Service
from test_release_roots import BUILD, ROOT, bare_root, run

USER = 10001
MOST_BYTES = 120e6

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="making images needs root"),
    pytest.mark.skipif(shutil.which("buildah") is None, reason="without buildah"),
    pytest.mark.skipif(shutil.which("debootstrap") is None, reason="without debootstrap"),
]


class Buildah:
    """Calls buildah with a storage of its own."""

    def __init__(self, folder):
        self._command = ["buildah", "--storage-driver", "vfs", "--root", folder / "root", "--runroot", folder / "run"]

    def __call__(self, *arguments, **options):
        return run(*self._command, *arguments, **options).stdout.strip()


@pytest.fixture(scope="module")
def buildah(tmp_path_factory):
    """Returns a buildah with the image `localhost/spikeserve`."""
    folder = tmp_path_factory.mktemp("image")
    buildah = Buildah(folder)
    base = folder / "base.tar"
    run("tar", "-C", bare_root(), "--exclude=./proc/*", "--exclude=./dev/*", "-cf", base, ".")
    container = buildah("from", "scratch")
    buildah("add", "-q", container, base, "/")
    buildah("commit", "-q", "--rm", container, "localhost/base")
    context = folder / "context"
    shutil.copytree(ROOT / "deploy/image", context / "deploy/image")
    run("cpack", "-G", "DEB", "-B", context / "dist", cwd=BUILD)
    buildah(
        *("bud", "--isolation", "chroot", "--format", "docker", "-t", "localhost/spikeserve"),
        *("--build-arg", "BASE=localhost/base", "--build-arg", "SOURCE=packages"),
        *("-f", context / "deploy/image/Dockerfile", context),
    )
    return buildah


@pytest.fixture(scope="module")
def configuration(buildah):
    return json.loads(buildah("inspect", "--type", "image", "localhost/spikeserve"))["Docker"]["config"]


@pytest.fixture(scope="module")
def files(buildah, tmp_path_factory):
    """Returns the root of a container, mounted."""
    container = buildah("from", "localhost/spikeserve")
    return pathlib.Path(buildah("mount", container))


def test_the_image_is_small_and_has_no_shell(files):
    size = sum(path.lstat().st_size for path in files.rglob("*") if path.is_file() and not path.is_symlink())
    assert size < MOST_BYTES
    programs = sorted(path.name for path in (files / "usr/bin").iterdir())
    assert programs == ["spikectl", "spikeserve"]
    assert (files / "usr/share/spikeserve/policies/cartpole/1/policy.safetensors").exists()
    assert "Package: libprotobuf32" in (files / "var/lib/dpkg/status.d/libprotobuf32").read_text()


def test_the_image_says_how_it_runs(configuration):
    assert configuration["User"] == f"{USER}:{USER}"
    assert configuration["Entrypoint"] == ["/usr/bin/spikeserve"]
    assert configuration["Healthcheck"]["Test"] == ["CMD", "/usr/bin/spikectl", "health"]
    assert configuration["StopSignal"] == "SIGTERM"


@contextlib.contextmanager
def container(files, configuration, *arguments, **environment):
    """Runs the image as process 1 of namespaces of its own, with a read-only root. Yields the process."""
    inside = f"""
        mount --bind {files} {files}
        mount -t proc proc {files}/proc 2>/dev/null || true
        mount -o remount,bind,ro {files}
        exec chroot --userspec={configuration["User"]} {files} "$@"
    """
    variables = dict(entry.split("=", 1) for entry in configuration["Env"]) | environment
    process = subprocess.Popen(
        [
            *("unshare", "--mount", "--pid", "--fork", "--kill-child", "--", "/bin/sh", "-c", inside, "sh"),
            *configuration["Entrypoint"],
            *arguments,
        ],
        env={"PATH": "/usr/sbin:/usr/bin:/sbin:/bin"} | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def first_process(process):
    """Returns the id, in this namespace, of the process that is 1 in its own."""
    [child] = pathlib.Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return int(child)


def test_it_serves_as_process_1_and_ends_in_order(files, configuration):
    free = {"SPIKESERVE_LISTEN": "127.0.0.1:0", "SPIKESERVE_HTTP_LISTEN": "127.0.0.1:0"}
    with container(files, configuration, "--reflection_v1alpha", **free) as process:
        address = process.stdout.readline().split()[-1]
        server = first_process(process)
        status = pathlib.Path(f"/proc/{server}/status").read_text()
        assert f"Uid:\t{USER}\t{USER}" in status
        assert status.split("NSpid:")[1].split()[1] == "1"
        inside = ("chroot", f"--userspec={USER}:{USER}", files)
        assert run(*inside, "/usr/bin/spikectl", "health", f"--server={address}").stdout == "SERVING\n"
        with grpc.insecure_channel(address) as channel:
            service = Service(channel, "spikeserve.v1.PolicyService")
            session = service.OpenSession(policy="cartpole").session_id
            service.Act(session_id=session, observation=[0.0] * 4)
        os.kill(server, signal.SIGTERM)
        assert process.wait(timeout=DEADLINE_SECONDS) == 0


def test_it_refuses_a_network_without_tls_and_tokens(files, configuration):
    with container(files, configuration) as process:
        assert process.wait(timeout=DEADLINE_SECONDS) != 0
        assert "insecure_network" in process.stderr.read()
