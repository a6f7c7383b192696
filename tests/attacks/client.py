"""A new client: connects, asks for the server's health, or as a robot for an action, and waits for the answer."""

import contextlib
import socket
import ssl
import time

from tests.attacks import frames
from tests.attacks.websocket import Robot

CALL_SECONDS = 1
PAUSE_SECONDS = 0.02


def is_served(address, tls):
    """Returns true if a new connection is served within CALL_SECONDS."""
    host, _, port = address.removeprefix("ws://").rpartition(":")
    with contextlib.suppress(OSError), contextlib.ExitStack() as stack:
        if address.startswith("ws://"):
            robot = stack.enter_context(Robot((host, int(port)), "Authorization: Api-Key rival", seconds=CALL_SECONDS))
            return b"actions" in robot.call()
        connection = stack.enter_context(
            socket.create_connection((host, int(port)), timeout=CALL_SECONDS)
        )
        if tls:
            context = ssl.create_default_context()
            context.check_hostname = False
            context.verify_mode = ssl.CERT_NONE
            context.set_alpn_protocols(["h2"])
            connection = stack.enter_context(context.wrap_socket(connection))
        headers = frames.frame(frames.HEADERS, frames.request(frames.HEALTH), frames.END_HEADERS, 1)
        message = frames.frame(frames.DATA, frames.framed(b""), frames.END_STREAM, 1)
        connection.sendall(frames.PREFACE + frames.settings() + headers + message)
        return answered(connection)
    return False


def answered(connection):
    """Reads frames until DATA of stream 1, which is true, or the end of the connection."""
    received = b""
    while chunk := connection.recv(1 << 16):
        received += chunk
        while len(received) >= 9 and len(received) >= (size := 9 + int.from_bytes(received[:3])):
            if received[3] == frames.DATA and received[5:9] == b"\0\0\0\1":
                return True
            received = received[size:]
    return False


def seconds_until_served(address, tls, limit):
    """Returns how long it takes until a new client is served, or None after `limit` seconds."""
    start = time.monotonic()
    while (waited := time.monotonic() - start) < limit:
        if is_served(address, tls):
            return time.monotonic() - start
        time.sleep(PAUSE_SECONDS)
    return None if waited >= limit else waited
