"""The part of a stream that the blocking and the asyncio client share."""

from __future__ import annotations

import time
from typing import Generic

import grpc
from numpy.typing import ArrayLike

from spikeserve.caller import Caller
from spikeserve.errors import SessionLostError, SpikeserveError, make_error
from spikeserve.lines import LONGEST_SECONDS
from spikeserve.open_requests import OpenRequest, OpenRequests, stream_closed
from spikeserve.replicas import Route
from spikeserve.session_handle import AnySession
from spikeserve.stream_opener import StreamOpener
from spikeserve.values import Decision, ExecutedLike
from spikeserve.wire import Message


class StreamCore(Generic[AnySession]):
    """Sends the requests of a stream and matches its replies. Opens another stream if it breaks."""

    def __init__(self, client: Caller) -> None:
        self._client = client
        self._opener = StreamOpener(client)
        self._open: OpenRequests[AnySession] = OpenRequests(
            self._opener, client.options, client.patience
        )
        self._closed = False

    @property
    def route(self) -> Route:
        """Returns the way of the calls of the stream, for `open_session` of the client."""
        return self._opener.route

    async def _send(
        self,
        session: AnySession,
        observation: ArrayLike,
        reward: float | None = None,
        *,
        executed_action: ExecutedLike | None = None,
    ) -> None:
        """Sends a request for the decision at the step of `session`. Does not wait for the answer.

        The arguments are those of Session.act. UnavailableError if the stream is broken and the
        policy for retries allows no other one.
        """
        if self._closed:
            raise stream_closed()
        if self._open.broken is not None and not self._open.may_reopen():
            raise self._open.broken
        if self._open.broken is not None or self._is_over():
            await self._start()
        await self._write(self._open.add(session, observation, reward, executed_action))

    async def _receive(
        self, timeout: float | None = None
    ) -> tuple[AnySession, Decision | SpikeserveError]:
        deadline = None if timeout is None else time.monotonic() + min(timeout, LONGEST_SECONDS)
        while True:
            if self._open.broken is not None:
                raise self._open.broken
            reply = await self._next_reply(deadline)
            if reply is None:
                if deadline is not None and time.monotonic() >= deadline:
                    message = f"no answer within {timeout} s"
                    raise make_error("ActStream", grpc.StatusCode.DEADLINE_EXCEEDED, message)
                continue
            is_error = isinstance(reply, SpikeserveError)
            accepted = reply if is_error else self._open.accept(reply)
            if isinstance(accepted, SpikeserveError):
                await self._break(accepted)
            elif isinstance(accepted, OpenRequest):
                answered = await self._find(accepted)
                if answered is not None:
                    return answered
            elif accepted is not None:
                return accepted
            else:
                self._resend_later()

    async def _act(
        self,
        session: AnySession,
        observation: ArrayLike,
        reward: float | None,
        executed_action: ExecutedLike | None,
        timeout: float | None = None,
    ) -> Decision:
        self._open.check_empty()
        await self._send(session, observation, reward, executed_action=executed_action)
        result = (await self._receive(timeout))[1]
        if isinstance(result, SpikeserveError):
            raise result
        return result

    async def _find(
        self, request: OpenRequest[AnySession]
    ) -> tuple[AnySession, Decision | SpikeserveError] | None:
        """Makes the call of a request outside of the stream. None: in a new session, later."""
        session = request.session
        try:
            return session, await self._client.perform(request.call)
        except SessionLostError as error:
            if not session.reopens:
                return session, error
        except SpikeserveError as error:
            return session, error
        await session._open_again()
        await self._write(self._open.restart(request))
        return None

    async def _start(self) -> None:
        """Opens another stream, and sends the requests without an answer again."""
        self._open_call()
        self._open.broken = None
        for request in self._open.all_messages():
            await self._write(request)

    def _is_over(self) -> bool:
        """Returns whether the call has ended although `broken` does not say so yet."""
        return False

    def _resend_later(self) -> None:
        """Sends refused requests again when they are due, unless the next reply waits for that."""

    def _open_call(self) -> None:
        """Replaces the call by another one."""
        raise NotImplementedError

    async def _write(self, request: Message) -> None:
        raise NotImplementedError

    async def _next_reply(self, deadline: float | None) -> Message | SpikeserveError | None:
        """Returns the next reply, the error that ended the call, or None after some time."""
        raise NotImplementedError

    async def _break(self, error: SpikeserveError) -> None:
        """Opens another stream after `error`, at once or later, or marks the stream as broken."""
        raise NotImplementedError
