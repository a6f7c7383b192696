"""The messages of the wire contract, compiled from proto/. Needs no reflection, which is itself under test."""

import functools
import pathlib
import subprocess
import tempfile

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

PROTO = pathlib.Path(__file__).parents[2] / "proto"
FILES = [
    "spikeserve/v1/policy_service.proto",
    "spikeserve/v1/policy_admin.proto",
    "inference/grpc_service.proto",
    "grpc/health/v1/health.proto",
    "grpc/reflection/v1/reflection.proto",
    "google/rpc/error_details.proto",
    "google/rpc/status.proto",
]


@functools.cache
def _pool():
    with tempfile.NamedTemporaryFile() as compiled:
        subprocess.run(
            [
                "protoc",
                f"-I{PROTO}",
                "--include_imports",
                f"--descriptor_set_out={compiled.name}",
                *FILES,
            ],
            check=True,
        )
        files = descriptor_pb2.FileDescriptorSet.FromString(compiled.read())
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return pool


@functools.cache
def message_class(name):
    """Returns the class of a message, for example of "spikeserve.v1.ActRequest"."""
    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(name))


def v1(name, **fields):
    """Returns a message of the package spikeserve.v1."""
    return message_class(f"spikeserve.v1.{name}")(**fields)


def call(channel, path):
    """Returns the method `path`, "/SERVICE/METHOD", of `channel` as a callable that takes and returns messages."""
    service, method = path[1:].split("/")
    described = _pool().FindServiceByName(service).FindMethodByName(method)
    kind = "_".join(
        "stream" if s else "unary" for s in (described.client_streaming, described.server_streaming)
    )
    return getattr(channel, kind)(
        path,
        request_serializer=lambda message: message.SerializeToString(),
        response_deserializer=message_factory.GetMessageClass(described.output_type).FromString,
    )
