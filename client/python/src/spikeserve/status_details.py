"""Reads the details of a gRPC status: when a refused call may be repeated, and which decision a
session expects.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from google.protobuf import message

from spikeserve.wire import message_class

METADATA_KEY = "grpc-status-details-bin"


@dataclass(frozen=True)
class Details:
    """What a status says beside its code and message. None: nothing."""

    retry_delay: float | None = None  # seconds
    expected_decision: int | None = None
    expected_episode: int | None = None


STATUS, RETRY_INFO, _ERROR_INFO = (
    message_class(name, "google.rpc") for name in ("Status", "RetryInfo", "ErrorInfo")
)


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
                if name == "google.rpc.RetryInfo":
                    delay = RETRY_INFO.FromString(detail.value).retry_delay
                    found = replace(found, retry_delay=delay.seconds + delay.nanos / 1e9)
                elif name == "google.rpc.ErrorInfo":
                    known = _ERROR_INFO.FromString(detail.value).metadata
                    for field in ("expected_decision", "expected_episode"):
                        if known.get(field, "").isdecimal():
                            found = replace(found, **{field: int(known[field])})
        except message.DecodeError:
            return found
    return found
