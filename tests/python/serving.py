"""Starts a real server. Provides a client that uses reflection and no file of this repository."""

import contextlib
import functools
import http.client
import json
import os
import pathlib
import shlex
import shutil
import signal
import subprocess
import tempfile

import grpc
from google.protobuf import descriptor_pool, message_factory
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import (
    ProtoReflectionDescriptorDatabase,
)

DEPLOY = pathlib.Path(__file__).parents[2] / "deploy"
SHIPPED_POLICIES = DEPLOY / "policies"
# Small policies for CartPole that a release left: cartpole-sparse/1 in float32, and two in int8.
RELEASED_POLICIES = DEPLOY.parent / "tests/releases/0.1.0/policies"
# How many times as long as usual a test may take, for emulated processors.
TEST_TIME = int(os.environ.get("TEST_TIME", "1"))
DEADLINE_SECONDS = 30 * TEST_TIME
POLICY = "spikeserve.v1.PolicyService"
ADMIN = "spikeserve.v1.PolicyAdmin"


def add_version(policies, name, version=1, source=SHIPPED_POLICIES / "cartpole/1"):
    """Copies a version, in one step, as another one below the folder `policies`. Returns its file."""
    folder = policies / name / str(version)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=policies.parent) as new:
        pathlib.Path(shutil.copytree(source, f"{new}/{version}")).rename(folder)
    return folder / "policy.safetensors"


class Server:
    """A running server: its addresses, HOST:PORT, its process, and its services, which are called without a token."""

    def __init__(self, process, status):
        self.process = process
        self.status = status  # with which it is to end
        self.grpc = self.http = self.datagrams = ""

    @functools.cached_property
    def channel(self):
        return grpc.insecure_channel(self.grpc)

    @functools.cached_property
    def agent(self):
        return Service(self.channel, POLICY)

    @functools.cached_property
    def admin(self):
        return Service(self.channel, ADMIN)

    def kill(self):
        """Kills the server without a chance to say goodbye."""
        self.status = -signal.SIGKILL
        self.process.kill()
        self.process.wait()

    def stop(self):
        """Keeps the server from running until `resume`. Returns when all of its threads have stopped."""
        self.process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, self.process.pid, os.WSTOPPED)

    def resume(self):
        """Lets a stopped server run again."""
        self.process.send_signal(signal.SIGCONT)

    def spikectl(self, *arguments, **options):
        """Runs spikectl for this server, as run() does."""
        return run("spikectl", *arguments, f"--server={self.grpc}", timeout=4 * DEADLINE_SECONDS, **options)


def run(program, *arguments, status=0, **options):
    """Runs a program to its end and returns its subprocess.CompletedProcess, with its output as text.

    A program of the build has its plain name, such as spikectl. Asserts its exit status; None: it may be any.
    """
    command = [os.environ.get(f"{program}_PROGRAM".upper(), program), *map(str, arguments)]
    finished = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert status in (None, finished.returncode), f"{command}: {finished.stdout}{finished.stderr}"
    return finished


def refusal_at_start(*flags, policies=SHIPPED_POLICIES):
    """Returns the error of a server that does not start with these flags."""
    free = ["--listen=127.0.0.1:0", "--http_listen=127.0.0.1:0"]
    return run("spikeserve", f"--policies={policies}", *free, *flags, status=1, timeout=DEADLINE_SECONDS).stderr


@contextlib.contextmanager
def running_server(policies=SHIPPED_POLICIES, flags=(), log=None, prefix=(), status=0):
    """Starts a server with the policies of a folder and yields it as a Server.

    Asserts that the server ends with `status` at the latest at the SIGTERM that follows, unless it was killed. The server
    appends its log to the file at the path `log`, or logs to what Popen takes; None: to stderr. The variable
    SPIKESERVE_SERVER_FLAGS holds flags of every server. Of a flag that is repeated, the last one counts. `prefix` is a
    command that runs the server in its own process, such as prlimit.
    """
    command = [
        *prefix,
        os.environ["SPIKESERVE_PROGRAM"],
        f"--policies={policies}",
        "--listen=127.0.0.1:0",
        "--http_listen=127.0.0.1:0",
        "--reflection_v1alpha",  # the version that grpcio-reflection speaks
        *shlex.split(os.environ.get("SPIKESERVE_SERVER_FLAGS", "")),
        *flags,
    ]
    with log.open("a") if isinstance(log, pathlib.Path) else contextlib.nullcontext(log) as stderr:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stderr, text=True)
    server = Server(process, status)

    def announced(protocol):
        announcement = f"spikeserve: serving {protocol} on "
        line = process.stdout.readline()
        assert line.startswith(announcement), f"stdout: expected {announcement!r}, received {line!r}"
        return line.removeprefix(announcement).strip()

    try:
        server.grpc = announced("gRPC")
        if "--http_listen=" not in flags:
            server.http = announced("HTTP")
        if any(flag.startswith("--datagram_listen=") for flag in flags):
            server.datagrams = announced("datagrams")
        yield server
        process.terminate()
        assert process.wait(timeout=DEADLINE_SECONDS) == server.status
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        if "channel" in vars(server):
            server.channel.close()


def http_call(address, method, path, body=None, token=None, **headers):
    """Returns the code, the headers and the body of the answer to a request. Names of headers have _ for -."""
    if token is not None:
        headers["Authorization"] = f"Bearer {token}"
    connection = http.client.HTTPConnection(address, timeout=DEADLINE_SECONDS)
    connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
    response = connection.getresponse()
    content = response.read()
    connection.close()
    return response.status, response.headers, content


def page_of(server, path, token=None):
    """Returns the text of a page. `server` has the address `http`."""
    code, _, content = http_call(server.http, "GET", path, token=token)
    assert code == 200, content
    return content.decode()


def status_of(server, query="", token=None):
    return json.loads(page_of(server, f"/status.json{query}", token))


def series(server, name, token=None, **labels):
    """Returns the values of the series of this name that have the labels."""
    page = page_of(server, "/metrics", token)
    lines = [line for line in page.splitlines() if line.startswith((name + "{", name + " "))]
    found = [line for line in lines if all(f'{label}="{value}"' in line for label, value in labels.items())]
    return [float(line.rsplit(" ", 1)[1]) for line in found]


def metric(server, name, token=None, **labels):
    """Returns the sum of these series. There has to be one."""
    found = series(server, name, token, **labels)
    assert found, f"{name} {labels}"
    return sum(found)


def message_class(channel, name):
    """Returns the class of a message that the reflection of the server describes."""
    pool = descriptor_pool.DescriptorPool(ProtoReflectionDescriptorDatabase(channel))
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def _bound(channel, method):
    kind = "_".join("stream" if each else "unary" for each in (method.client_streaming, method.server_streaming))
    request_class = message_factory.GetMessageClass(method.input_type)
    call = getattr(channel, kind)(
        f"/{method.containing_service.full_name}/{method.name}",
        request_serializer=request_class.SerializeToString,
        response_deserializer=message_factory.GetMessageClass(method.output_type).FromString,
    )
    return request_class, call


def method_of(channel, service, name, calls=None):
    """Returns the class of a method's requests, and the method, which takes and returns messages.

    They come from the reflection of the server on `channel`. The calls use the channel `calls`, or `channel` if it is None.
    """
    pool = descriptor_pool.DescriptorPool(ProtoReflectionDescriptorDatabase(channel))
    return _bound(calls or channel, pool.FindServiceByName(service).methods_by_name[name])


class Service:
    """Has one Python method for each unary method of a service.

    The methods and messages come from the reflection of the server on `channel`. The calls use the channel `calls`, or
    `channel` if it is None.
    """

    def __init__(self, channel, name, calls=None):
        pool = descriptor_pool.DescriptorPool(ProtoReflectionDescriptorDatabase(channel))
        for method in pool.FindServiceByName(name).methods:
            if not method.client_streaming and not method.server_streaming:
                setattr(self, method.name, self._unary(calls or channel, method))

    @staticmethod
    def _unary(channel, method):
        request_class, call = _bound(channel, method)
        return lambda **fields: call(request_class(**fields), timeout=DEADLINE_SECONDS)


def schedule_of(pid, *names):
    """Returns the processor time of the threads of these names so far, and how often they have run."""
    nanoseconds = times = 0
    for task in pathlib.Path(f"/proc/{pid}/task").iterdir():
        if (task / "comm").read_text().strip() in names:
            spent, _, runs = map(int, (task / "schedstat").read_text().split())
            nanoseconds += spent
            times += runs
    return nanoseconds / 1e9, times
