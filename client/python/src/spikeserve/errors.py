"""The exceptions of calls: one class for each gRPC status that the wire contract names.

The message comes from the server. It names the field, the expected value and the received value.
"""

from __future__ import annotations

import grpc


class SpikeserveError(Exception):
    """A call that failed.

    `call` is the name of the method and `code` the status code of gRPC. `message` comes from the
    server, or from gRPC if no server was reached.
    """

    def __init__(self, call: str, code: grpc.StatusCode, message: str) -> None:
        super().__init__(f"{call}: {code.name}: {message}")
        self.call = call
        self.code = code
        self.message = message


class InvalidArgumentError(SpikeserveError):
    """A field has a wrong value. The session did not change."""


class NotFoundError(SpikeserveError):
    """The session, policy or version does not exist. The server closes idle sessions."""


class FailedPreconditionError(SpikeserveError):
    """The step is not the expected one, or the episode to end has no decision yet."""


class ResourceExhaustedError(SpikeserveError):
    """A limit of the server is reached."""


class UnauthenticatedError(SpikeserveError):
    """The credentials are missing, unknown or expired."""


class PermissionDeniedError(SpikeserveError):
    """The credentials do not allow this call."""


class UnimplementedError(SpikeserveError):
    """The server does not support this call."""


class UnavailableError(SpikeserveError):
    """Every attempt failed: the server was not reached, or it was shutting down."""


class DeadlineExceededError(SpikeserveError):
    """Every attempt failed: no response came within the timeout."""


_CLASSES: dict[grpc.StatusCode, type[SpikeserveError]] = {
    grpc.StatusCode.INVALID_ARGUMENT: InvalidArgumentError,
    grpc.StatusCode.NOT_FOUND: NotFoundError,
    grpc.StatusCode.FAILED_PRECONDITION: FailedPreconditionError,
    grpc.StatusCode.RESOURCE_EXHAUSTED: ResourceExhaustedError,
    grpc.StatusCode.UNAUTHENTICATED: UnauthenticatedError,
    grpc.StatusCode.PERMISSION_DENIED: PermissionDeniedError,
    grpc.StatusCode.UNIMPLEMENTED: UnimplementedError,
    grpc.StatusCode.UNAVAILABLE: UnavailableError,
    grpc.StatusCode.DEADLINE_EXCEEDED: DeadlineExceededError,
}

_CODES = {code.value[0]: code for code in grpc.StatusCode}


def make_error(call: str, code: grpc.StatusCode, message: str) -> SpikeserveError:
    """Returns the exception for a status."""
    return _CLASSES.get(code, SpikeserveError)(call, code, message)


def error_of_call(call: str, error: grpc.RpcError) -> SpikeserveError:
    """Returns the exception for an error of grpc or grpc.aio."""
    return make_error(call, error.code(), error.details() or "")


def error_of_item(call: str, code: int, message: str) -> SpikeserveError:
    """Returns the exception for one item of a batch or stream. `code` is a gRPC status number."""
    return make_error(call, _CODES.get(code, grpc.StatusCode.UNKNOWN), message)


def is_retryable(error: SpikeserveError) -> bool:
    """Returns whether to repeat the call: the server may or may not have carried it out."""
    return isinstance(error, UnavailableError | DeadlineExceededError)
