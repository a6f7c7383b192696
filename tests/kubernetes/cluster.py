"""A Kubernetes API server on etcd, without nodes and controllers: it takes, refuses and keeps objects."""

import contextlib
import json
import pathlib
import signal
import socket
import ssl
import subprocess
import time
import urllib.error
import urllib.request

TOKEN = "robots"  # of an administrator
DEADLINE_SECONDS = 180


def free_ports(count):
    """Returns ports that were free just now. kube-apiserver cannot be asked for the port that it took."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


class Cluster:
    """The API of a cluster that runs."""

    def __init__(self, url, kubeconfig):
        self._url = url
        self.kubeconfig = kubeconfig

    def call(self, path, method="GET", body=None):
        """Returns the status of a request and its JSON."""
        request = urllib.request.Request(
            self._url + path, method=method, data=json.dumps(body).encode() if body else None
        )
        request.add_header("Authorization", f"Bearer {TOKEN}")
        request.add_header("Content-Type", "application/json")
        unchecked = ssl.create_default_context()
        unchecked.check_hostname, unchecked.verify_mode = False, ssl.CERT_NONE
        try:
            with urllib.request.urlopen(request, timeout=30, context=unchecked) as answer:
                return answer.status, json.loads(answer.read())
        except urllib.error.HTTPError as error:
            return error.code, json.loads(error.read() or "{}")

    def create(self, path, body):
        status, answer = self.call(path, "POST", body)
        assert status == 201, answer

    def define(self, group, kind, plural):
        """Defines a kind of another program, whose objects may have any fields."""
        version = {
            "name": "v1",
            "served": True,
            "storage": True,
            "schema": {"openAPIV3Schema": {"type": "object", "x-kubernetes-preserve-unknown-fields": True}},
        }
        definition = {
            "apiVersion": "apiextensions.k8s.io/v1",
            "kind": "CustomResourceDefinition",
            "metadata": {"name": f"{plural}.{group}"},
            "spec": {
                "group": group,
                "scope": "Namespaced",
                "names": {"kind": kind, "plural": plural, "singular": kind.lower()},
                "versions": [version],
            },
        }
        self.create("/apis/apiextensions.k8s.io/v1/customresourcedefinitions", definition)
        wait(lambda: self.call(f"/apis/{group}/v1/namespaces/default/{plural}")[0] == 200, plural)


def wait(condition, what, processes=()):
    deadline = time.monotonic() + DEADLINE_SECONDS
    while not condition():
        for process in processes:
            assert process.poll() is None, f"{process.args[0]} has ended"
        assert time.monotonic() < deadline, f"{what}: expected within {DEADLINE_SECONDS} s"
        time.sleep(0.1)


@contextlib.contextmanager
def running_cluster(apiserver, folder):
    """Starts etcd and the program `apiserver`, and yields the Cluster."""
    client, peer, port = free_ports(3)
    key = folder / "accounts.key"
    subprocess.run(["openssl", "genrsa", "-out", key, "2048"], check=True, capture_output=True)
    (folder / "tokens.csv").write_text(f"{TOKEN},administrator,1,system:masters\n")
    log = (folder / "cluster.log").open("w")
    etcd = subprocess.Popen(
        [
            *("etcd", "--data-dir", folder / "etcd", "--unsafe-no-fsync"),
            *(
                "--listen-client-urls",
                f"http://127.0.0.1:{client}",
                "--advertise-client-urls",
                f"http://127.0.0.1:{client}",
            ),
            *(
                "--listen-peer-urls",
                f"http://127.0.0.1:{peer}",
                "--initial-advertise-peer-urls",
                f"http://127.0.0.1:{peer}",
            ),
            *("--initial-cluster", f"default=http://127.0.0.1:{peer}"),
        ],
        stdout=log,
        stderr=log,
    )
    server = subprocess.Popen(
        [
            *(
                apiserver,
                f"--etcd-servers=http://127.0.0.1:{client}",
                f"--secure-port={port}",
                "--bind-address=127.0.0.1",
            ),
            *(
                f"--cert-dir={folder}/certificates",
                f"--token-auth-file={folder}/tokens.csv",
                "--authorization-mode=RBAC",
            ),
            *(f"--service-account-key-file={key}", f"--service-account-signing-key-file={key}"),
            *("--service-account-issuer=https://spikeserve.test", "--service-cluster-ip-range=10.96.0.0/16"),
            "--disable-admission-plugins=ServiceAccount",  # a controller would make the default account
        ],
        stdout=log,
        stderr=log,
    )
    try:
        url = f"https://127.0.0.1:{port}"
        kubeconfig = folder / "kubeconfig"
        kubeconfig.write_text(configuration(url))
        cluster = Cluster(url, kubeconfig)

        def ready():
            with contextlib.suppress(OSError, ValueError):
                return cluster.call("/api/v1/namespaces/default")[0] == 200
            return False

        try:
            wait(ready, "kube-apiserver", (etcd, server))
        except AssertionError as error:
            raise AssertionError(f"{error}\n{pathlib.Path(log.name).read_text()[-4000:]}") from None
        yield cluster
    finally:
        for process in (server, etcd):
            process.send_signal(signal.SIGKILL)
            process.wait()
        log.close()


def configuration(url):
    cluster = {"name": "test", "cluster": {"server": url, "insecure-skip-tls-verify": True}}
    return json.dumps(
        {
            "apiVersion": "v1",
            "kind": "Config",
            "clusters": [cluster],
            "users": [{"name": "administrator", "user": {"token": TOKEN}}],
            "contexts": [{"name": "test", "context": {"cluster": "test", "user": "administrator"}}],
            "current-context": "test",
        }
    )
