"""`Connection`: the connection of the blocking client."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from typing import TYPE_CHECKING, Any, TypeVar

import grpc

from spikeserve.caller import Caller
from spikeserve.calls import Call
from spikeserve.channels import ClientOptions
from spikeserve.coroutines import finish
from spikeserve.errors import (
    DeadlineExceededError,
    SpikeserveError,
    error_of_call,
    is_retryable,
    is_retryable_code,
)
from spikeserve.lines import GRACE_SECONDS, RACE_SECONDS, SERVING, LineWatch, has_answered
from spikeserve.replicas import PROBE_SECONDS, Replica
from spikeserve.wire import Message

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on

T = TypeVar("T")


class Connection(Caller):
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
        if winner is fresh:
            with contextlib.suppress(queue.Empty):
                winner = old if has_answered(ended.get(timeout=GRACE_SECONDS)) else fresh
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
        return finish(self.perform(call))

    async def _wait(self, seconds: float) -> None:
        time.sleep(seconds)

    async def _explained(self, error: SpikeserveError, replica: Replica) -> SpikeserveError:
        return self._explain(error, replica)

    async def _attempt(
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
            response = finish(self._attempt(call, call.request, replica, timeout))
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
