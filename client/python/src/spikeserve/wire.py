"""The messages and calls of `spikeserve.v1.PolicyService`.

They are made from the compiled wire contract, not from generated code: generated code demands a
protobuf runtime at least as new as its compiler, which would fight with whatever else an agent has
installed. The descriptors live in a pool of their own, so that a program may also have classes
generated from the same .proto.
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

# The classes exist at run time only.
Message = Any


def _load_pool() -> descriptor_pool.DescriptorPool:
    files = descriptor_pb2.FileDescriptorSet()
    files.ParseFromString(importlib.resources.files(__package__).joinpath(_COMPILED).read_bytes())
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return pool


_POOL = _load_pool()


def message_class(name: str) -> Message:
    """The class of the message `name` of the package, for example `ActRequest`."""
    return message_factory.GetMessageClass(_POOL.FindMessageTypeByName(f"{PACKAGE}.{name}"))


@dataclass(frozen=True)
class Method:
    """A unary call of the service."""

    name: str
    request: Message
    response: Message

    def bind(self, channel: Any) -> Callable[..., Any]:
        """What calls the method on `channel`, a channel of grpc or grpc.aio."""
        call: Callable[..., Any] = channel.unary_unary(
            f"/{SERVICE}/{self.name}",
            request_serializer=self.request.SerializeToString,
            response_deserializer=self.response.FromString,
        )
        return call


def _unary_methods() -> dict[str, Method]:
    return {
        method.name: Method(
            name=method.name,
            request=message_factory.GetMessageClass(method.input_type),
            response=message_factory.GetMessageClass(method.output_type),
        )
        for method in _POOL.FindServiceByName(SERVICE).methods
        if not method.client_streaming and not method.server_streaming
    }


METHODS = _unary_methods()
