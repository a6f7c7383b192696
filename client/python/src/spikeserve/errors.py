"""The exceptions of calls: one class for each gRPC status that the wire contract names.

The message comes from the server. It names the field, the expected value and the received value.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import grpc

from spikeserve.printing import printable
from spikeserve.status_details import details_of

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on


class SpikeserveError(Exception):
    """A call that failed.

    `call` is the name of the method and `code` the status code of gRPC. `message` comes from the
    server, or from gRPC if no server was reached. `retry_after` is the time in seconds after which
    the server expects that the call may succeed; None: it did not say.
    """

    def __init__(
        self, call: str, code: grpc.StatusCode, message: str, retry_after: float | None = None
    ) -> None:
        super().__init__(f"{call}: {code.name}: {printable(message)}")  # a traceback prints it
        self.call = call
        self.code = code
        self.message = message
        self.retry_after = retry_after


class InvalidArgumentError(SpikeserveError):
    """A field has a wrong value. The session did not change."""


class NotFoundError(SpikeserveError):
    """The session, policy or version does not exist. The server closes idle sessions."""


class SessionLostError(NotFoundError):
    """The server does not know the session any more: it was restarted, or it ended the session.

    `session_ids` are the ids of the lost sessions. A session that was opened with `reopen=True`
    opens a new one instead.
    """

    session_ids: Sequence[str] = ()


class FailedPreconditionError(SpikeserveError):
    """The step is not the expected one, or the episode to end has no decision yet.

    `expected_decision` is the number of the decision that the session expects, and
    `expected_episode` the index of its running episode; None: the server did not say.
    """

    expected_decision: int | None = None
    expected_episode: int | None = None


class DivergedError(SpikeserveError):
    """A request that was sent again after the loss of a server got another answer than before.

    The session goes on from the new answer. `decision` is the number of the decision, or of the one
    that follows the end of an episode.
    """

    decision: int = 0

    @classmethod
    def of(cls, call: str, session_id: str, decision: int) -> Self:
        """Returns the error for a request of a session."""
        error = cls(
            call,
            grpc.StatusCode.DATA_LOSS,
            f"session {session_id}: expected the answer of decision {decision} that was received "
            "before, received another one",
        )
        error.decision = decision
        return error


class ResourceExhaustedError(SpikeserveError):
    """A limit of the server is reached. `retry_after` says when to try again, if it is known."""


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


def make_error(
    call: str,
    code: grpc.StatusCode,
    message: str,
    retry_after: float | None = None,
    expected_decision: int | None = None,
    expected_episode: int | None = None,
) -> SpikeserveError:
    """Returns the exception for a status."""
    error = _CLASSES.get(code, SpikeserveError)(call, code, message, retry_after)
    if isinstance(error, FailedPreconditionError):
        error.expected_decision = expected_decision
        error.expected_episode = expected_episode
    return error


def error_of_call(call: str, error: grpc.RpcError) -> SpikeserveError:
    """Returns the exception for an error of grpc or grpc.aio."""
    details, message = details_of(error), error.details() or ""
    code = code_of_end(error.code(), message)
    place = details.expected_decision, details.expected_episode
    return make_error(call, code, message, details.retry_delay, *place)


def code_of_end(code: grpc.StatusCode, message: str) -> grpc.StatusCode:
    """Returns the code of a call that ended with a code and message of grpc.

    A proxy resets the calls of a server that has ended: nginx with INTERNAL_ERROR, HAProxy with
    CANCEL. gRPC makes INTERNAL and CANCELLED of them. UNAVAILABLE shows what they mean.
    """
    is_reset = code in (grpc.StatusCode.INTERNAL, grpc.StatusCode.CANCELLED)
    return grpc.StatusCode.UNAVAILABLE if is_reset and "RST_STREAM" in message else code


def error_of_item(call: str, item: Any) -> SpikeserveError:
    """Returns the exception for an ActResult or an ActError, whose code is not 0."""
    return make_error(
        call,
        _CODES.get(item.code, grpc.StatusCode.UNKNOWN),
        item.message,
        item.retry_after_seconds if item.HasField("retry_after_seconds") else None,
        item.expected_decision if item.HasField("expected_decision") else None,
        item.expected_episode if item.HasField("expected_episode") else None,
    )


def expected_decision(error: SpikeserveError) -> int | None:
    """Returns the decision that the session expects if the request of `error` was out of order."""
    return error.expected_decision if isinstance(error, FailedPreconditionError) else None


def expected_episode(error: SpikeserveError) -> int | None:
    """Returns the episode of that decision, if the server has named it."""
    return error.expected_episode if isinstance(error, FailedPreconditionError) else None


def for_session(error: SpikeserveError, session_id: str) -> SpikeserveError:
    """Returns the exception for `error` of a call that names a session: SessionLostError for one.

    A session is all that such a call can fail to find.
    """
    return lost_session(error, session_id) if isinstance(error, NotFoundError) else error


def lost_session(error: SpikeserveError, session_id: str) -> SessionLostError:
    """Returns the SessionLostError for `error`."""
    lost = SessionLostError(error.call, error.code, error.message, error.retry_after)
    lost.session_ids = (session_id,)
    return lost


def is_retryable(error: SpikeserveError) -> bool:
    """Returns whether to repeat the call: the server may or may not have carried it out."""
    return is_retryable_code(error.code)


def is_retryable_code(code: grpc.StatusCode) -> bool:
    """As is_retryable, of a status code."""
    return code in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.DEADLINE_EXCEEDED)


def is_said_again(error: SpikeserveError) -> bool:
    """Returns whether the call that follows one of missing decisions shows what is still missing.

    A server that does not know the session is one of several, and that call asks the others, too.
    """
    is_elsewhere = isinstance(error, NotFoundError)
    return is_elsewhere or is_retryable(error) or expected_decision(error) is not None


def was_refused(error: SpikeserveError) -> bool:
    """Returns whether the server refused the call for now and said when to repeat it."""
    return isinstance(error, ResourceExhaustedError) and error.retry_after is not None
