"""Reads the details of a gRPC status: when a refused call may be repeated, and which decision a
session expects.

The messages of google.rpc are made here, because the package that has them is not a dependency.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from google.protobuf import (
    any_pb2,
    descriptor_pb2,
    descriptor_pool,
    duration_pb2,
    message,
    message_factory,
)

METADATA_KEY = "grpc-status-details-bin"
_RETRY_INFO_NAME = "google.rpc.RetryInfo"
_ERROR_INFO_NAME = "google.rpc.ErrorInfo"


@dataclass(frozen=True)
class Details:
    """What a status says beside its code and message. None: nothing."""

    retry_delay: float | None = None  # seconds
    expected_decision: int | None = None
    expected_episode: int | None = None


def _message_classes() -> tuple[Any, Any, Any]:
    pool = descriptor_pool.DescriptorPool()
    for dependency in (any_pb2, duration_pb2):
        pool.AddSerializedFile(dependency.DESCRIPTOR.serialized_pb)
    file = descriptor_pb2.FileDescriptorProto(
        name="spikeserve/google_rpc.proto",
        package="google.rpc",
        syntax="proto3",
        dependency=["google/protobuf/any.proto", "google/protobuf/duration.proto"],
    )
    kinds = descriptor_pb2.FieldDescriptorProto
    optional, repeated = kinds.LABEL_OPTIONAL, kinds.LABEL_REPEATED
    status = file.message_type.add(name="Status")
    status.field.add(name="code", number=1, type=kinds.TYPE_INT32, label=optional)
    status.field.add(name="message", number=2, type=kinds.TYPE_STRING, label=optional)
    status.field.add(
        name="details",
        number=3,
        type=kinds.TYPE_MESSAGE,
        type_name=".google.protobuf.Any",
        label=repeated,
    )
    retry_info = file.message_type.add(name="RetryInfo")
    retry_info.field.add(
        name="retry_delay",
        number=1,
        type=kinds.TYPE_MESSAGE,
        type_name=".google.protobuf.Duration",
        label=optional,
    )
    error_info = file.message_type.add(name="ErrorInfo")
    error_info.field.add(name="reason", number=1, type=kinds.TYPE_STRING, label=optional)
    # On the wire, a map is a list of pairs.
    pair = error_info.nested_type.add(name="Pair")
    pair.field.add(name="key", number=1, type=kinds.TYPE_STRING, label=optional)
    pair.field.add(name="value", number=2, type=kinds.TYPE_STRING, label=optional)
    error_info.field.add(
        name="metadata",
        number=3,
        type=kinds.TYPE_MESSAGE,
        type_name=".google.rpc.ErrorInfo.Pair",
        label=repeated,
    )
    pool.Add(file)
    names = ("google.rpc.Status", _RETRY_INFO_NAME, _ERROR_INFO_NAME)
    found = [message_factory.GetMessageClass(pool.FindMessageTypeByName(name)) for name in names]
    return found[0], found[1], found[2]


STATUS, RETRY_INFO, _ERROR_INFO = _message_classes()


def details_of(error: Any) -> Details:
    """Returns the details of an error of grpc or grpc.aio, as far as they can be read."""
    metadata = error.trailing_metadata() if hasattr(error, "trailing_metadata") else None
    found = Details()
    for key, value in metadata or ():
        if key != METADATA_KEY:
            continue
        try:
            for detail in STATUS.FromString(value).details:
                name = detail.type_url.rpartition("/")[2]
                if name == _RETRY_INFO_NAME:
                    delay = RETRY_INFO.FromString(detail.value).retry_delay
                    found = replace(found, retry_delay=delay.seconds + delay.nanos / 1e9)
                elif name == _ERROR_INFO_NAME:
                    pairs = _ERROR_INFO.FromString(detail.value).metadata
                    known = {pair.key: pair.value for pair in pairs}
                    for field in ("expected_decision", "expected_episode"):
                        if known.get(field, "").isdecimal():
                            found = replace(found, **{field: int(known[field])})
        except message.DecodeError:
            return found
    return found
