"""`AsyncConnection`: the connection of the asyncio client."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any

import grpc
import grpc.aio

from spikeserve.caller import Caller
from spikeserve.calls import Call
from spikeserve.channels import ClientOptions
from spikeserve.errors import SpikeserveError, is_retryable_code
from spikeserve.lines import (
    GRACE_SECONDS,
    RACE_SECONDS,
    SERVING,
    SILENCE_SECONDS,
    Line,
    LineRenewedError,
    is_answer,
)
from spikeserve.replicas import PROBE_SECONDS, Replica
from spikeserve.wire import Message

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on


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


class AsyncConnection(Caller):
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
            checks = [asyncio.ensure_future(self._is_answered(line)) for line in (old, fresh)]
            for check in asyncio.as_completed(checks):
                if (line := await check) is not None:
                    winner = line
                    break
            if winner is fresh:
                with contextlib.suppress(asyncio.TimeoutError):
                    late = await asyncio.wait_for(checks[0], GRACE_SECONDS)
                    winner = late or fresh
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

    run = Caller.perform

    async def _wait(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def _explained(self, error: SpikeserveError, replica: Replica) -> SpikeserveError:
        return await asyncio.to_thread(self._explain, error, replica)

    async def _attempt(
        self, call: Call[Any], request: Message, replica: Replica, timeout: float
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
        self._reached = True
        replica.doubt.answered()
        return response

    async def call(self, name: str, request: Message, timeout: float | None = None) -> Message:
        """Asyncio form of Connection.call."""
        return await self.run(Call(name, request, lambda response: response, timeout))
