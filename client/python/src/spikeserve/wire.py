"""The messages and calls of the services of `spikeserve.v1`, and the messages of `google.rpc`.

This module makes them at import time from the compiled wire contract. Generated code would need a
protobuf runtime at least as new as its compiler, which may conflict with other packages of an
agent. A separate descriptor pool allows a program to use classes generated from the same .proto.
"""

from __future__ import annotations

import functools
import importlib.resources
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from google.protobuf import (
    any_pb2,
    descriptor_pb2,
    descriptor_pool,
    duration_pb2,
    message_factory,
)

PACKAGE = "spikeserve.v1"
SERVICE = f"{PACKAGE}.PolicyService"
ADMIN_SERVICE = f"{PACKAGE}.PolicyAdmin"
_COMPILED = "contract.binpb"
_PART_BYTES = 32 << 10  # of a file in one message; within every tenant's limit of a request

# A message of the wire contract. Its class exists at run time only, so type checkers see Any.
Message = Any


def _load_files() -> descriptor_pb2.FileDescriptorSet:
    files = descriptor_pb2.FileDescriptorSet()
    files.ParseFromString(importlib.resources.files(__package__).joinpath(_COMPILED).read_bytes())
    return files


def _make_pool(files: descriptor_pb2.FileDescriptorSet) -> descriptor_pool.DescriptorPool:
    pool = descriptor_pool.DescriptorPool()
    for imported in (descriptor_pb2, any_pb2, duration_pb2):  # which the contract uses
        pool.AddSerializedFile(imported.DESCRIPTOR.serialized_pb)
    for file in files.file:
        pool.Add(file)
    return pool


def _make_classes(files: descriptor_pb2.FileDescriptorSet) -> dict[str, Message]:
    # At once: two threads that ask for a class for the first time may get two that do not fit.
    pool = _make_pool(files)
    names = [f"{file.package}.{kind.name}" for file in files.file for kind in file.message_type]
    classes = map(message_factory.GetMessageClass, map(pool.FindMessageTypeByName, names))
    return dict(zip(names, classes, strict=True))


_FILES = _load_files()
_CLASSES = _make_classes(_FILES)


def message_class(name: str, package: str = PACKAGE) -> Message:
    """Returns the class of the message `name` of the package, for example `ActRequest`."""
    return _CLASSES[f"{package}.{name}"]


@dataclass(frozen=True)
class Method:
    """A method of a service: unary, an upload in parts, or a stream in both directions."""

    service: str
    name: str
    request: Message
    response: Message
    streams: bool
    is_upload: bool  # which has one answer
    repeatable: bool  # declared as free of side effects or idempotent

    def bind(self, channel: Any) -> Callable[..., Any]:
        """Returns a function that calls the method on `channel`, of grpc or grpc.aio."""
        make = channel.stream_stream if self.streams else channel.unary_unary
        call: Callable[..., Any] = (channel.stream_unary if self.is_upload else make)(
            f"/{self.service}/{self.name}",
            request_serializer=self.request.SerializeToString,
            response_deserializer=self.response.FromString,
        )
        return functools.partial(_upload, call) if self.is_upload else call


def _upload(call: Callable[..., Any], request: Message, **options: Any) -> Any:
    """Calls with everything of `request` but its data, and then with these in short parts."""
    head = type(request)()
    head.CopyFrom(request)
    head.ClearField("data")
    parts = (
        type(request)(data=[data[begin : begin + _PART_BYTES]])
        for data in request.data
        for begin in range(0, len(data), _PART_BYTES)
    )
    return call(itertools.chain([head], parts), **options)


def _methods(service_name: str) -> dict[str, Method]:
    # Reads the file descriptors, because method descriptors of older protobuf versions do not say
    # which methods are streams.
    return {
        method.name: Method(
            service=service_name,
            name=method.name,
            request=message_class(method.input_type.rpartition(".")[2]),
            response=message_class(method.output_type.rpartition(".")[2]),
            streams=method.client_streaming,
            is_upload=method.client_streaming and not method.server_streaming,
            repeatable=method.options.idempotency_level
            != descriptor_pb2.MethodOptions.IDEMPOTENCY_UNKNOWN,
        )
        for file in _FILES.file
        for service in file.service
        if f"{file.package}.{service.name}" == service_name
        for method in service.method
    }


def comment_of(service_name: str, method_name: str) -> str:
    """Returns the comment of a method in the wire contract."""
    for file in _FILES.file:
        comments = {tuple(c.path): c.leading_comments for c in file.source_code_info.location}
        for i, service in enumerate(file.service):
            if f"{file.package}.{service.name}" != service_name:
                continue
            for j, method in enumerate(service.method):
                if method.name == method_name:
                    # The path of method j of service i, in the numbers of descriptor.proto.
                    return str(comments.get((6, i, 2, j), "")).strip()
    return ""


METHODS = _methods(SERVICE)
ADMIN_METHODS = _methods(ADMIN_SERVICE)
ACT_STREAM = METHODS["ActStream"]
