"""What a call raises: one class for each status that the server's contract names.

The message is the server's own: it names the field, what was expected and what was received.
"""

from __future__ import annotations

import grpc


class SpikeserveError(Exception):
    """A call that failed.

    `call` is the method's name, `code` gRPC's status code, `message` what the server said (or
    gRPC itself, if no server was reached).
    """

    def __init__(self, call: str, code: grpc.StatusCode, message: str) -> None:
        super().__init__(f"{call}: {code.name}: {message}")
        self.call = call
        self.code = code
        self.message = message


class InvalidArgumentError(SpikeserveError):
    """A field has a wrong value; the session is as it was."""


class NotFoundError(SpikeserveError):
    """There is no such session (it may have been idle for too long), policy or version."""


class FailedPreconditionError(SpikeserveError):
    """The step is not the expected one, or an episode ended that never began."""


class ResourceExhaustedError(SpikeserveError):
    """A limit of the server is reached."""


class UnauthenticatedError(SpikeserveError):
    """The server asks for credentials, or for others."""


class PermissionDeniedError(SpikeserveError):
    """The credentials do not allow this call."""


class UnimplementedError(SpikeserveError):
    """The server does not do that."""


class UnavailableError(SpikeserveError):
    """No server was reached, or it is going away; every attempt failed."""


class DeadlineExceededError(SpikeserveError):
    """No answer came within the timeout; every attempt failed."""


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
    """The exception for a status."""
    return _CLASSES.get(code, SpikeserveError)(call, code, message)


def error_of_call(call: str, error: grpc.RpcError) -> SpikeserveError:
    """The exception for what grpc or grpc.aio raised."""
    return make_error(call, error.code(), error.details() or "")


def error_of_item(call: str, code: int, message: str) -> SpikeserveError:
    """The exception for one item of a batch; `code` is gRPC's number."""
    return make_error(call, _CODES.get(code, grpc.StatusCode.UNKNOWN), message)


def is_retryable(error: SpikeserveError) -> bool:
    """Whether nobody knows if the call was carried out."""
    return isinstance(error, UnavailableError | DeadlineExceededError)
