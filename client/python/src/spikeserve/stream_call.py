"""`StreamCall`: one call of ActStream, whose replies a thread passes on."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable
from typing import Any

import grpc

from spikeserve.errors import SpikeserveError, error_of_call
from spikeserve.open_requests import stream_ended
from spikeserve.wire import Message


class StreamCall:
    """Sends requests without waiting. Thread-safe.

    Calls `on_reply` with each reply and `on_end` once with the error that ended the call, on a
    thread of its own, in order.
    """

    def __init__(
        self,
        open_call: Callable[[Iterable[Message]], Any],
        on_reply: Callable[[StreamCall, Message], None],
        on_end: Callable[[StreamCall, SpikeserveError], None],
    ) -> None:
        self._requests: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        self._on_reply = on_reply
        self._on_end = on_end
        self._open_call = open_call
        self._call: Any = None
        self._is_cancelled = False

    def start(self) -> None:
        """Opens the call, which sends what was to be sent. ValueError if the channel is closed."""
        self._call = self._open_call(iter(self._requests.get, None))
        if self._is_cancelled:
            self._call.cancel()
        self._reader = threading.Thread(target=self._read, name="spikeserve-stream", daemon=True)
        self._reader.start()

    def send(self, request: Message) -> None:
        """Sends a request."""
        self._requests.put(request)

    def cancel(self) -> None:
        """Ends the call. `on_end` follows."""
        self._requests.put(None)
        self._is_cancelled = True
        if self._call is not None:
            self._call.cancel()

    def end(self) -> None:
        """Ends the call and waits for the return of `on_end`."""
        self.cancel()
        self._reader.join()

    def _read(self) -> None:
        error = stream_ended()
        try:
            for reply in self._call:
                self._on_reply(self, reply)
        except grpc.RpcError as ended:
            # A fresh connection has cancelled it, or a proxy whose server has ended.
            is_cut = ended.code() == grpc.StatusCode.CANCELLED and not self._is_cancelled
            error = error if is_cut else error_of_call("ActStream", ended)
        self._requests.put(None)  # lets the thread of gRPC that takes the requests end
        self._on_end(self, error)
