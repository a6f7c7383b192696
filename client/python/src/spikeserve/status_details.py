"""Reads the details of a gRPC status: the time after which a refused call may be repeated.

The messages of google.rpc are made here, because the package that has them is not a dependency.
"""

from __future__ import annotations

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


def _message_classes() -> tuple[Any, Any]:
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
    pool.Add(file)
    names = ("google.rpc.Status", _RETRY_INFO_NAME)
    found = [message_factory.GetMessageClass(pool.FindMessageTypeByName(name)) for name in names]
    return found[0], found[1]


STATUS, RETRY_INFO = _message_classes()


def retry_delay_of(error: Any) -> float | None:
    """Returns the delay in seconds of google.rpc.RetryInfo of an error of grpc or grpc.aio.

    Returns None if the server sent none, or details that cannot be read.
    """
    metadata = error.trailing_metadata() if hasattr(error, "trailing_metadata") else None
    for key, value in metadata or ():
        if key != METADATA_KEY:
            continue
        try:
            for detail in STATUS.FromString(value).details:
                if detail.type_url.rpartition("/")[2] == _RETRY_INFO_NAME:
                    delay = RETRY_INFO.FromString(detail.value).retry_delay
                    return float(delay.seconds + delay.nanos / 1e9)
        except message.DecodeError:
            return None
    return None
