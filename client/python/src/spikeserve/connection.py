"""`Connection`: sends calls, waits for their responses and repeats failed attempts. Blocks."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import grpc

from spikeserve.calls import Call
from spikeserve.channels import Channels, ClientOptions
from spikeserve.errors import (
    DeadlineExceededError,
    FailedPreconditionError,
    SpikeserveError,
    error_of_call,
    is_retryable,
    is_retryable_code,
    is_said_again,
)
from spikeserve.lines import RACE_SECONDS, SERVING, LineWatch, has_answered
from spikeserve.replicas import PROBE_SECONDS, Replica
from spikeserve.retry import Attempts
from spikeserve.wire import Message

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on

T = TypeVar("T")


class Connection(Channels):
    """Runs calls and blocks until they end. Thread-safe."""

    _transport = grpc

    def __init__(
        self,
        server: str | None = None,
        options: ClientOptions | None = None,
        credentials: grpc.ChannelCredentials | None = None,
    ) -> None:
        super().__init__(server, options, credentials)
        self._watch = LineWatch(self.suspect)

    def _start_race(self, replica: Replica) -> None:
        threading.Thread(
            target=self._race, args=[replica], name="spikeserve-race", daemon=True
        ).start()

    def _race(self, replica: Replica) -> None:
        old, fresh = replica.line, self._connect(replica.address)
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        checks = {}
        with contextlib.suppress(ValueError):  # the client was closed meanwhile
            for line in (old, fresh):
                check = line.health.future(
                    b"", timeout=RACE_SECONDS, metadata=self._options.metadata
                )
                checks[check] = line
                check.add_done_callback(ended.put)
        finished = (ended.get() for _ in range(len(checks)))
        winner = next((checks[check] for check in finished if has_answered(check)), old)
        if winner is fresh and not self._is_closed:
            replica.renew(fresh)
        replica.doubt.raced(winner is fresh)
        # Cancels the calls that wait on the old line; they are sent again on the fresh one.
        (old if replica.line is fresh else fresh).channel.close()
        if self._is_closed:
            replica.line.channel.close()

    def _probe(self, replica: Replica) -> None:
        metadata = self._options.metadata
        check = replica.line.health.future(b"", timeout=PROBE_SECONDS, metadata=metadata)
        check.add_done_callback(lambda done: self.replicas.probed(replica, _serves(done)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection. The server keeps every session that was not closed."""
        self._is_closed = True
        for replica in self.replicas:
            replica.line.channel.close()

    def run(self, call: Call[T]) -> T:
        """Returns the value of `call`. Repeats failed attempts as the options say.

        Sends decisions again that the server expects and that were made before.
        """
        attempts = self._attempts(call)
        while True:
            try:
                return self._run_with(call, attempts)
            except FailedPreconditionError as error:
                missing = call.missing(error) if call.missing is not None else []
                pause = attempts.pause_before_missing() if missing else None
                if pause is None:
                    raise
            time.sleep(pause)
            self._send_missing(missing, attempts)

    def _run_with(self, call: Call[T], attempts: Attempts) -> T:
        response = self._response(call, call.request, attempts)
        while call.failed_items is not None and (failed := call.failed_items(response)):
            pause = attempts.pause_before_part(failed)
            if pause is None:
                break
            time.sleep(pause)
            self._send_missing(failed.missing, attempts)
            failed.merge(self._response(call, failed.request, attempts))
        return call.decode(response)

    def _send_missing(self, missing: Sequence[Call[None]], attempts: Attempts) -> None:
        for part in missing:
            try:
                self._run_with(part, attempts)
            except SpikeserveError as error:
                # The call that follows shows what is still missing.
                if not is_said_again(error):
                    raise

    def _response(self, call: Call[Any], request: Message, attempts: Attempts) -> Message:
        while True:
            replica, timeout = attempts.replica, attempts.timeout()
            try:
                response = self._attempt(call, request, replica, timeout)
            except grpc.RpcError as error:
                try:
                    pause = attempts.pause_after(error, timeout)
                except SpikeserveError as last:
                    # A call of a connection that was made once must fail without delay.
                    raise last if self._reached else self._explain(last, replica) from error
            else:
                attempts.answered()
                return response
            if pause is None:
                return self._table[call.method].response()
            time.sleep(pause)

    def _attempt(
        self, call: Call[Any], request: Message, replica: Replica, timeout: float
    ) -> Message:
        while True:
            line, began = replica.line, time.monotonic()
            watched = self._watch.begin(replica, began)
            try:
                response: Message = self._send(line, call, request, timeout)
            except grpc.RpcError as failed:
                raise self._note_failure(failed, replica, line, began) from None
            except ValueError:  # the channel was closed before the call began
                if line is replica.line:
                    raise
            else:
                self._reached = True
                replica.doubt.answered()
                return response
            finally:
                self._watch.end(watched)

    def run_once(self, call: Call[T], replica: Replica, timeout: float) -> T:
        """Returns the value of `call`, or raises the error of its only attempt, at `replica`."""
        try:
            response = self._attempt(call, call.request, replica, timeout)
        except grpc.RpcError as failed:
            error = error_of_call(call.method, failed)
            if is_retryable(error):
                is_silent = isinstance(error, DeadlineExceededError)
                self.replicas.failed(replica, timeout if is_silent else None)
            raise error from failed
        self.replicas.answered(call.route, replica)
        return call.decode(response)

    def call(self, name: str, request: Message, timeout: float | None = None) -> Message:
        """Returns the response of the unary method `name`, for example of Explain."""
        return self.run(Call(name, request, lambda response: response, timeout))


def _serves(check: Any) -> bool:
    """Returns whether the server of a finished health check serves, which may not have Health."""
    try:
        return bool(check.result() == SERVING)
    except grpc.RpcError as error:
        return not is_retryable_code(error.code())
    except grpc.FutureCancelledError:
        return False
