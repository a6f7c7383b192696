"""A WebSocket that ends clients which send more frames than a robot needs.

A message is bounded in bytes, but not in its fragments, and no bytes at all are enough for a ping.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.frames import DATA_OPCODES, CloseCode, Frame, Opcode
from websockets.protocol import SEND_EOF, State

_PIECE = 1024  # bytes that are read before other connections have their turn again
_BURST = 256  # frames at once, and fragments of a message; each KiB of them allows one more
_RATE = 2000  # frames a second
_KIB = 1024


class Connection(ServerConnection):
    """Belongs to one event loop."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._frames = 0.0  # of late
        self._fragments = 0.0  # of the message that is being received
        self._at = self.loop.time()
        self._is_over = False

    def data_received(self, data: bytes) -> None:
        """Reads what arrives, but not before the request is answered, and not after too much."""
        for begin in range(0, len(data), _PIECE):
            if self.request is not None and self.protocol.state is State.CONNECTING:
                self.transport.abort()
            if self._is_over or self.transport.is_closing():
                return
            super().data_received(data[begin : begin + _PIECE])

    def send_data(self) -> None:
        """Sends all that is due in one write, since asyncio logs each to a client that has gone."""
        due = self.protocol.data_to_send()
        data = b"".join(due)
        self.protocol.writes = [data] * bool(data) + [SEND_EOF] * (SEND_EOF in due)
        super().send_data()

    def process_event(self, event: Any) -> None:
        """Handles the request, then frames."""
        if isinstance(event, Frame):
            if self.protocol.state is not State.OPEN:
                return
            if self._is_too_many(event):
                self.protocol.fail(
                    CloseCode.POLICY_VIOLATION, "frames: expected fewer or longer ones"
                )
                self.send_data()
                self._is_over = True
                return
            # The parser keeps the frame until the next one, but not what is in it.
            parsed, event = event, dataclasses.replace(event)
            parsed.data = b""
        super().process_event(event)

    def _is_too_many(self, frame: Frame) -> bool:
        now = self.loop.time()
        cost = 1 - len(frame.data) / _KIB
        self._frames = max(0.0, self._frames - (now - self._at) * _RATE + cost)
        self._at = now
        if frame.opcode in DATA_OPCODES:
            self._fragments = cost + (self._fragments if frame.opcode is Opcode.CONT else 0)
        return max(self._frames, self._fragments) > _BURST
