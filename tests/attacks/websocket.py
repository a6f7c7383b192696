"""A robot of the gateway: the frames of WebSocket that it sends and receives, in a few lines."""

import socket
import struct

CALL_SECONDS = 30
ZEROS = b"\x81\xabobservation\x94" + 4 * b"\x00"  # in MessagePack: {"observation": [0, 0, 0, 0]}


class RefusedError(ConnectionError):
    """The gateway does not make a connection of this request."""


def request(*headers):
    """Returns the request for a connection."""
    lines = ["GET / HTTP/1.1", "Host: localhost", "Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
    return "\r\n".join([*lines, f"Sec-WebSocket-Key: {'A' * 22}==", *headers, "", ""]).encode()


class Robot:
    """A connection; raises RefusedError if there is none to be had. Use it as a context."""

    def __init__(self, address, *headers, seconds=CALL_SECONDS):
        self._socket = socket.create_connection(address, timeout=seconds)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._received = self._socket.makefile("rb")
        self._socket.sendall(request(*headers))
        status = self._received.readline()
        while self._received.readline().strip():
            pass
        if b" 101 " not in status:
            self.close()
            raise RefusedError(status)
        self.receive()  # the metadata

    def send(self, message):
        """Sends a binary frame, masked with zeros."""
        self._socket.sendall(b"\x82\xff" + struct.pack(">Q", len(message)) + bytes(4))
        self._socket.sendall(message)

    def receive(self):
        """Returns the content of a frame."""
        head = self._received.read(2)
        if len(head) < 2 or head[0] & 15 == 8:
            raise ConnectionResetError
        size = head[1]
        if size > 125:
            size = int.from_bytes(self._received.read(2 if size == 126 else 8))
        return self._received.read(size)

    def call(self, message=ZEROS):
        """Sends a message. Returns its answer."""
        self.send(message)
        return self.receive()

    def close(self):
        """Ends the connection."""
        self._received.close()
        self._socket.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()
