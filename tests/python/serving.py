"""Starts a real server. Provides a client that uses reflection and no file of this repository."""

import contextlib
import json
import os
import pathlib
import shlex
import subprocess
import typing
import urllib.request

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


class Addresses(typing.NamedTuple):
    """The addresses, HOST:PORT, on which a server listens, and its process."""

    grpc: str
    http: str
    process: subprocess.Popen


@contextlib.contextmanager
def running_server(policies=SHIPPED_POLICIES, flags=(), log=None, prefix=(), status=0):
    """Starts a server with the policies of a folder and yields its Addresses.

    Asserts that the server ends with `status` at the latest at the SIGTERM that follows; -9 after it was killed. The server logs to `log`, an open file; None: to stderr. The
    variable SPIKESERVE_SERVER_FLAGS holds flags of every server. Of a flag that is repeated, the last one counts.
    `prefix` is a command that runs the server in its own process, such as prlimit.
    """
    server = subprocess.Popen(
        [
            *prefix,
            os.environ["SPIKESERVE_PROGRAM"],
            f"--policies={policies}",
            "--listen=127.0.0.1:0",
            "--http_listen=127.0.0.1:0",
            "--reflection_v1alpha",  # the version that grpcio-reflection speaks
            *shlex.split(os.environ.get("SPIKESERVE_SERVER_FLAGS", "")),
            *flags,
        ],
        stdout=subprocess.PIPE,
        stderr=log,
        text=True,
    )

    def announced(protocol):
        announcement = f"spikeserve: serving {protocol} on "
        line = server.stdout.readline()
        assert line.startswith(announcement), f"stdout: expected {announcement!r}, received {line!r}"
        return line.removeprefix(announcement).strip()

    try:
        http = "" if "--http_listen=" in flags else None
        yield Addresses(announced("gRPC"), announced("HTTP") if http is None else http, server)
        server.terminate()
        assert server.wait(timeout=DEADLINE_SECONDS) == status
    finally:
        server.kill()
        server.wait()
        server.stdout.close()


def page_of(server, path):
    """Returns the text of a page. `server` has the address `http`."""
    with urllib.request.urlopen(f"http://{server.http}{path}", timeout=DEADLINE_SECONDS) as page:
        return page.read().decode()


def status_of(server, query=""):
    return json.loads(page_of(server, f"/status.json{query}"))


def metric(server, name, **labels):
    """Returns the sum of the series of this name that have the labels. There has to be one."""
    lines = [line for line in page_of(server, "/metrics").splitlines() if line.startswith((name + "{", name + " "))]
    found = [line for line in lines if all(f'{label}="{value}"' in line for label, value in labels.items())]
    assert found, f"{name} {labels}"
    return sum(float(line.rsplit(" ", 1)[1]) for line in found)


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
