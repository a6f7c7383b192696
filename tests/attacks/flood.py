"""Sends scripts of bytes on many connections at once, and opens a closed connection anew."""

import dataclasses
import errno
import resource
import selectors
import socket
import time

PAUSE = object()  # in a script: send no more for PAUSE_SECONDS
CLOSE = object()  # in a script: open the connection anew
PAUSE_SECONDS = 0.01
RETRY_SECONDS = 0.02  # after a socket that could not be made


@dataclasses.dataclass
class Sent:
    """What an attack did."""

    bytes: int = 0
    connections: int = 0
    closed: int = 0  # connections that the server closed, or that failed


class ScriptEndedError(Exception):
    """The script says CLOSE."""


class Connection:
    """One non-blocking socket and the rest of its script."""

    def __init__(self, address, script, sent, source=None):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self.socket.setblocking(False)
        # No TIME_WAIT: an attack may open more connections than there are ports.
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if source is not None:
            self.socket.bind((source, 0))
        code = self.socket.connect_ex(address)
        if code not in (0, errno.EINPROGRESS):
            raise OSError(code, "connect")
        self.script = script
        self.rest = memoryview(b"")
        self.resume = 0.0
        self.ended = False  # the script has no more bytes; the connection stays open
        self._sent = sent
        sent.connections += 1

    def send(self, now):
        """Sends what the socket takes of one step of the script."""
        if not self.rest:
            step = next(self.script, None)
            if step is None:
                self.ended = True
            elif step is PAUSE:
                self.resume = now + PAUSE_SECONDS
            elif step is CLOSE:
                raise ScriptEndedError
            else:
                self.rest = memoryview(step)
        if self.rest:
            count = self.socket.send(self.rest)
            self._sent.bytes += count
            self.rest = self.rest[count:]

    def receive(self):
        """Discards what the server sent. Raises ConnectionError at the end of the connection."""
        if not self.socket.recv(1 << 18):
            raise ConnectionResetError


def _allow_descriptors(connections):
    """Raises the limit on open files, as far as the system lets the process."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = min(hard, connections + 100)
    if soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def flood(
    address, seconds, script, connections=1, read=True, enough=lambda: False, source=lambda: None
):
    """Runs script(), an iterator of bytes, PAUSE and CLOSE, on each connection for `seconds`. Returns Sent.

    A connection that the server closes is opened again, with a new script. `read`: discards what the server sends;
    otherwise lets it fill the buffers of the socket. Ends before its time as soon as `enough()` is true. source()
    returns the address that a connection comes from, or None.
    """
    sent = Sent()
    selector = selectors.DefaultSelector()
    reading = selectors.EVENT_READ if read else 0
    end = time.monotonic() + seconds
    opened = set()
    retry = 0.0
    _allow_descriptors(connections)

    def watch(connection, now):
        writing = 0 if connection.ended or now < connection.resume else selectors.EVENT_WRITE
        events = reading | writing
        registered = connection.socket in selector.get_map()
        if events and registered:
            selector.modify(connection.socket, events, connection)
        elif events:
            selector.register(connection.socket, events, connection)
        elif registered:
            selector.unregister(connection.socket)

    def drop(connection):
        if connection.socket in selector.get_map():
            selector.unregister(connection.socket)
        connection.socket.close()
        opened.discard(connection)

    while (now := time.monotonic()) < end and not enough():
        while len(opened) < connections and now >= retry:
            try:
                connection = Connection(address, script(), sent, source())
            except OSError:
                retry = now + RETRY_SECONDS
                break
            opened.add(connection)
            watch(connection, now)
        for connection in [paused for paused in opened if 0 < paused.resume <= now]:
            connection.resume = 0.0
            watch(connection, now)
        for key, events in selector.select(PAUSE_SECONDS):
            try:
                if events & selectors.EVENT_WRITE:
                    key.data.send(time.monotonic())
                    if key.data.ended or key.data.resume:
                        watch(key.data, time.monotonic())
                if events & selectors.EVENT_READ:
                    key.data.receive()
            except BlockingIOError:
                pass
            except ScriptEndedError:
                drop(key.data)
            except OSError:
                drop(key.data)
                sent.closed += 1
    for connection in list(opened):
        connection.socket.close()
    return sent
