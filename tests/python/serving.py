"""A real server, and a client that needs no file of this repository."""

import contextlib
import os
import pathlib
import subprocess
import typing

from google.protobuf import descriptor_pool, message_factory
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import (
    ProtoReflectionDescriptorDatabase,
)

DEPLOY = pathlib.Path(__file__).parents[2] / "deploy"
SHIPPED_POLICIES = DEPLOY / "policies"
DEADLINE_SECONDS = 30


class Addresses(typing.NamedTuple):
    """HOST:PORT of what a server listens on."""

    grpc: str
    http: str


@contextlib.contextmanager
def running_server(policies=SHIPPED_POLICIES, flags=(), log=None):
    """Yields the Addresses of a server with the policies in a folder; SIGTERM must end it well. What it logs goes to
    `log`, a file, if that is given.
    """
    server = subprocess.Popen(
        [
            os.environ["SPIKESERVE_PROGRAM"],
            f"--policies={policies}",
            "--listen=127.0.0.1:0",
            "--http_listen=127.0.0.1:0",
            *flags,
        ],
        stdout=subprocess.PIPE,
        stderr=log,
        text=True,
    )

    def announced(protocol):
        announcement = f"spikeserve: serving {protocol} on "
        line = server.stdout.readline()
        assert line.startswith(announcement), f"the server said {line!r}"
        return line.removeprefix(announcement).strip()

    try:
        yield Addresses(grpc=announced("gRPC"), http=announced("HTTP"))
        server.terminate()
        assert server.wait(timeout=DEADLINE_SECONDS) == 0
    finally:
        server.kill()
        server.wait()
        server.stdout.close()


def message_class(channel, name):
    """The class of a message that the server's reflection describes."""
    pool = descriptor_pool.DescriptorPool(ProtoReflectionDescriptorDatabase(channel))
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


class Service:
    """A service whose methods and messages come from the server's reflection over `channel`; its
    calls go over `calls`, if that is given.
    """

    def __init__(self, channel, name, calls=None):
        pool = descriptor_pool.DescriptorPool(ProtoReflectionDescriptorDatabase(channel))
        for method in pool.FindServiceByName(name).methods:
            if not method.client_streaming and not method.server_streaming:
                setattr(self, method.name, self._unary(calls or channel, name, method))

    @staticmethod
    def _unary(channel, service, method):
        request_class = message_factory.GetMessageClass(method.input_type)
        response_class = message_factory.GetMessageClass(method.output_type)
        call = channel.unary_unary(
            f"/{service}/{method.name}",
            request_serializer=request_class.SerializeToString,
            response_deserializer=response_class.FromString,
        )
        return lambda **fields: call(request_class(**fields), timeout=DEADLINE_SECONDS)
