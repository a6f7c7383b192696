"""`AsyncConnection`: the connection of the asyncio client."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import grpc
import grpc.aio

from spikeserve.calls import Call
from spikeserve.channels import Channels, ClientOptions
from spikeserve.errors import (
    FailedPreconditionError,
    SpikeserveError,
    is_retryable_code,
    is_said_again,
)
from spikeserve.lines import (
    RACE_SECONDS,
    SERVING,
    SILENCE_SECONDS,
    Line,
    LineRenewedError,
    is_answer,
)
from spikeserve.replicas import PROBE_SECONDS, Replica
from spikeserve.retry import Attempts
from spikeserve.wire import Message

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on

T = TypeVar("T")


class Watch:
    """Calls `suspect` again and again while something is waited for."""

    def __init__(self, suspect: Callable[[], None]) -> None:
        self._suspect = suspect
        self._loop = asyncio.get_running_loop()
        self._timer = self._loop.call_later(SILENCE_SECONDS, self._run)

    def _run(self) -> None:
        self._suspect()
        self._timer = self._loop.call_later(SILENCE_SECONDS, self._run)

    def stop(self) -> None:
        """Ends the watch."""
        self._timer.cancel()


def is_cancelled() -> bool:
    """Returns whether the running task was cancelled. Before Python 3.11: False, not known."""
    task = asyncio.current_task()
    return task is not None and getattr(task, "cancelling", int)() > 0


class AsyncConnection(Channels):
    """Runs calls with asyncio, any number of them at once. Belongs to one event loop."""

    _transport = grpc.aio

    def __init__(
        self,
        server: str | None = None,
        options: ClientOptions | None = None,
        credentials: grpc.ChannelCredentials | None = None,
    ) -> None:
        super().__init__(server, options, credentials)
        self._tasks: set[asyncio.Task[None]] = set()  # health checks and races

    def _run_aside(self, work: Coroutine[Any, Any, None]) -> None:
        if self._is_closed:  # calls that were under way fail then
            work.close()
            return
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _start_race(self, replica: Replica) -> None:
        self._run_aside(self._race(replica))

    async def _race(self, replica: Replica) -> None:
        old, fresh = replica.line, self._connect(replica.address)
        winner = old
        try:
            checks = {asyncio.ensure_future(self._is_answered(line)): line for line in (old, fresh)}
            for check in asyncio.as_completed(checks):
                if (line := await check) is not None:
                    winner = line
                    break
            for check_task in checks:
                check_task.cancel()
        finally:
            if winner is fresh and not self._is_closed:
                replica.renew(fresh)
            replica.doubt.raced(winner is fresh)
            await (old if replica.line is fresh else fresh).channel.close()

    async def _is_answered(self, line: Line) -> Line | None:
        """Returns the line if its server answers a health check, whatever the answer is."""
        metadata = self._options.metadata
        try:
            await line.health(b"", timeout=RACE_SECONDS, metadata=metadata)
        except grpc.RpcError as error:
            return line if is_answer(error.code()) else None
        return line

    def _probe(self, replica: Replica) -> None:
        self._run_aside(self._check_health(replica))

    async def _check_health(self, replica: Replica) -> None:
        metadata = self._options.metadata
        try:
            answer = await replica.line.health(b"", timeout=PROBE_SECONDS, metadata=metadata)
            serves = answer == SERVING
        except grpc.RpcError as error:
            serves = not is_retryable_code(error.code())
        self.replicas.probed(replica, serves)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Asyncio form of Connection.close."""
        self._is_closed = True
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for replica in self.replicas:
            await replica.line.channel.close()

    async def run(self, call: Call[T]) -> T:
        """Asyncio form of Connection.run."""
        attempts = self._attempts(call)
        while True:
            try:
                return await self._run_with(call, attempts)
            except FailedPreconditionError as error:
                missing = call.missing(error) if call.missing is not None else []
                pause = attempts.pause_before_missing() if missing else None
                if pause is None:
                    raise
            await asyncio.sleep(pause)
            await self._send_missing(missing, attempts)

    async def _run_with(self, call: Call[T], attempts: Attempts) -> T:
        response = await self._response(call, call.request, attempts)
        while call.failed_items is not None and (failed := call.failed_items(response)):
            pause = attempts.pause_before_part(failed)
            if pause is None:
                break
            await asyncio.sleep(pause)
            await self._send_missing(failed.missing, attempts)
            failed.merge(await self._response(call, failed.request, attempts))
        return call.decode(response)

    async def _send_missing(self, missing: Sequence[Call[None]], attempts: Attempts) -> None:
        for part in missing:
            try:
                await self._run_with(part, attempts)
            except SpikeserveError as error:
                if not is_said_again(error):
                    raise

    async def _response(self, call: Call[Any], request: Message, attempts: Attempts) -> Message:
        while True:
            replica, timeout = attempts.replica, attempts.timeout()
            try:
                response = await self._attempt(replica, call, request, timeout)
            except grpc.RpcError as error:
                try:
                    pause = attempts.pause_after(error, timeout)
                except SpikeserveError as last:
                    if self._reached:
                        raise
                    raise await asyncio.to_thread(self._explain, last, replica) from error
            else:
                self._reached = True
                attempts.answered()
                return response
            if pause is None:
                return self._table[call.method].response()
            await asyncio.sleep(pause)

    async def _attempt(
        self, replica: Replica, call: Call[Any], request: Message, timeout: float
    ) -> Message:
        line, began = replica.line, time.monotonic()
        watch = Watch(lambda: self.suspect(replica, began))
        try:
            response = await self._send(line, call, request, timeout)
        except grpc.RpcError as error:
            raise self._note_failure(error, replica, line, began) from None
        except grpc.aio.UsageError:  # the channel was closed before the call began
            if line is replica.line:
                raise
            raise LineRenewedError from None
        except asyncio.CancelledError:  # also of a call whose channel was closed
            if line is replica.line or is_cancelled():
                raise
            raise LineRenewedError from None
        finally:
            watch.stop()
        replica.doubt.answered()
        return response

    async def call(self, name: str, request: Message, timeout: float | None = None) -> Message:
        """Asyncio form of Connection.call."""
        return await self.run(Call(name, request, lambda response: response, timeout))
