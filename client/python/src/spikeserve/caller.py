"""`Caller`: sends calls, waits for their responses and repeats failed attempts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import grpc

from spikeserve.calls import Call
from spikeserve.channels import Channels
from spikeserve.errors import FailedPreconditionError, SpikeserveError, is_said_again
from spikeserve.replicas import Replica
from spikeserve.retry import Attempts
from spikeserve.wire import Message

T = TypeVar("T")


class Caller(Channels):
    """The calls of both connections, which define how an attempt is made and a pause is waited."""

    async def perform(self, call: Call[T]) -> T:
        """Returns the value of `call`. Repeats failed attempts as the options say.

        Sends decisions again that the server expects and that were made before.
        """
        attempts = self._attempts(call)
        while True:
            try:
                return await self._perform_with(call, attempts)
            except FailedPreconditionError as error:
                missing = call.missing(error) if call.missing is not None else []
                pause = attempts.pause_before_missing() if missing else None
                if pause is None:
                    raise
            await self._wait(pause)
            await self._send_missing(missing, attempts)

    async def _perform_with(self, call: Call[T], attempts: Attempts) -> T:
        response = await self._response(call, call.request, attempts)
        while call.failed_items is not None and (failed := call.failed_items(response)):
            pause = attempts.pause_before_part(failed)
            if pause is None:
                break
            await self._wait(pause)
            await self._send_missing(failed.missing, attempts)
            failed.merge(await self._response(call, failed.request, attempts))
        return call.decode(response)

    async def _send_missing(self, missing: Sequence[Call[None]], attempts: Attempts) -> None:
        for part in missing:
            try:
                await self._perform_with(part, attempts)
            except SpikeserveError as error:
                # The call that follows shows what is still missing.
                if not is_said_again(error):
                    raise

    async def _response(self, call: Call[Any], request: Message, attempts: Attempts) -> Message:
        while True:
            replica, timeout = attempts.replica, attempts.timeout()
            try:
                response = await self._attempt(call, request, replica, timeout)
            except grpc.RpcError as error:
                try:
                    pause = attempts.pause_after(error, timeout)
                except SpikeserveError as last:
                    # A call of a connection that was made once must fail without delay.
                    if self._reached:
                        raise
                    raise await self._explained(last, replica) from error
            else:
                attempts.answered()
                return response
            if pause is None:
                return self._table[call.method].response()
            await self._wait(pause)

    async def _attempt(
        self, call: Call[Any], request: Message, replica: Replica, timeout: float
    ) -> Message:
        """Makes one attempt. Returns the response, or raises grpc.RpcError."""
        raise NotImplementedError

    async def _wait(self, seconds: float) -> None:
        raise NotImplementedError

    async def _explained(self, error: SpikeserveError, replica: Replica) -> SpikeserveError:
        """Returns Channels._explain, which takes seconds."""
        raise NotImplementedError
