"""The messages and calls of `spikeserve.v1.PolicyService`.

This module makes them at import time from the compiled wire contract. Generated code would need a
protobuf runtime at least as new as its compiler, which may conflict with other packages of an
agent. A separate descriptor pool allows a program to use classes generated from the same .proto.
"""

from __future__ import annotations

import importlib.resources
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

PACKAGE = "spikeserve.v1"
SERVICE = f"{PACKAGE}.PolicyService"
_COMPILED = "policy_service.binpb"

# A message of the wire contract. Its class exists at run time only, so type checkers see Any.
Message = Any


def _load_files() -> descriptor_pb2.FileDescriptorSet:
    files = descriptor_pb2.FileDescriptorSet()
    files.ParseFromString(importlib.resources.files(__package__).joinpath(_COMPILED).read_bytes())
    return files


def _make_pool(files: descriptor_pb2.FileDescriptorSet) -> descriptor_pool.DescriptorPool:
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return pool


_FILES = _load_files()
_POOL = _make_pool(_FILES)


def message_class(name: str) -> Message:
    """Returns the class of the message `name` of the package, for example `ActRequest`."""
    return message_factory.GetMessageClass(_POOL.FindMessageTypeByName(f"{PACKAGE}.{name}"))


@dataclass(frozen=True)
class Method:
    """A method of the service: unary, or a stream in both directions."""

    name: str
    request: Message
    response: Message
    streams: bool

    def bind(self, channel: Any) -> Callable[..., Any]:
        """Returns a function that calls the method on `channel`, of grpc or grpc.aio."""
        make = channel.stream_stream if self.streams else channel.unary_unary
        call: Callable[..., Any] = make(
            f"/{SERVICE}/{self.name}",
            request_serializer=self.request.SerializeToString,
            response_deserializer=self.response.FromString,
        )
        return call


def _methods() -> dict[str, Method]:
    # Reads the file descriptors, because method descriptors of older protobuf versions do not say
    # which methods are streams.
    return {
        method.name: Method(
            name=method.name,
            request=message_class(method.input_type.rpartition(".")[2]),
            response=message_class(method.output_type.rpartition(".")[2]),
            streams=method.client_streaming,
        )
        for file in _FILES.file
        for service in file.service
        if f"{file.package}.{service.name}" == SERVICE
        for method in service.method
    }


METHODS = _methods()
ACT_STREAM = METHODS["ActStream"]
