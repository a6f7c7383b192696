"""A TCP route to a server, in the process of the test: with delay and loss, cut, or forgotten by a NAT."""

import collections
import contextlib
import random
import socket
import threading
import time

RETRANSMISSION = 0.2  # seconds, the least that Linux waits before it sends a lost segment again
SEGMENT = 1448  # bytes


class Link:
    """Forwards connections to `target`, HOST:PORT, which may change, and listens at `address`.

    `delay` is that of one direction in seconds. Of the segments, `loss` are lost and sent again: those that follow
    them wait, as with TCP. `cut` keeps everything back until `heal`, and `hold_answers` what comes from the target.
    `forget` keeps back what comes on the connections that are open, as a NAT that has forgotten them, while new ones
    work; `remember` forwards it.
    """

    def __init__(self, target, delay=0.0, loss=0.0, seed=0):
        self.target = target
        self.delay, self.loss = delay, loss
        self.random = random.Random(seed)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.address = f"127.0.0.1:{self.port}"
        self.accepted = 0  # connections
        self.changed = threading.Condition()
        self.is_cut = self.holds_answers = False
        self._pipes = []
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._listener.close()
        self.drop()

    def drop(self):
        """Ends all connections that are open."""
        with self.changed:
            pipes, self._pipes = self._pipes, []
        for pipe in pipes:
            pipe.close()

    def cut(self):
        """Keeps everything back, in both directions, until `heal`."""
        with self.changed:
            self.is_cut = True

    def hold_answers(self):
        """Keeps back what the target sends, until `heal`."""
        with self.changed:
            self.holds_answers = True

    def heal(self):
        """Forwards what was kept back, and what comes."""
        with self.changed:
            self.is_cut = self.holds_answers = False
            self.changed.notify_all()

    def forget(self):
        """Forwards nothing more on the connections that are open."""
        with self.changed:
            for pipe in self._pipes:
                pipe.is_forgotten = True

    def remember(self):
        """Forwards what was kept back on the connections that were forgotten. Returns when it is sent."""
        with self.changed:
            for pipe in self._pipes:
                pipe.is_forgotten = False
            self.changed.notify_all()
            self.changed.wait_for(lambda: not any(pipe.chunks for pipe in self._pipes))

    def close_ended(self):
        """Closes the connections of which both directions have ended."""
        with self.changed:
            ended = {pipe.source for pipe in self._pipes if pipe.has_ended}
            over = [pipe for pipe in self._pipes if pipe.has_ended and pipe.sink in ended]
            self._pipes = [pipe for pipe in self._pipes if pipe not in over]
        for pipe in over:
            pipe.close()

    def pieces(self, pipe):
        """Yields what is to be forwarded in one direction of a connection."""
        while data := pipe.source.recv(1 << 16):
            yield data

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                try:
                    host, _, port = self.target.rpartition(":")
                    server = socket.create_connection((host, int(port)))
                except OSError:
                    client.close()
                    continue
                for side in (client, server):
                    side.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                with self.changed:
                    self.accepted += 1
                    answers = Pipe(self, server, client)
                    self._pipes += [answers, Pipe(self, client, server, answers)]


class Pipe:
    """One direction of a connection: one thread reads, one writes when the time of a chunk has come.

    `answers` is the other direction; None: this is the direction of the answers.
    """

    def __init__(self, link, source, sink, answers=None):
        self._link, self.source, self.sink, self.answers = link, source, sink, answers
        self.is_forgotten = self.has_ended = False
        self.chunks = collections.deque()  # (time.monotonic() of its delivery, bytes; empty: the end)
        self._last = 0.0
        self._is_closed = False
        for work in (self._read, self._write):
            threading.Thread(target=work, daemon=True).start()

    def close(self):
        with self._link.changed:
            self._is_closed = True
            self._link.changed.notify_all()
        for side in (self.source, self.sink):
            with contextlib.suppress(OSError):
                side.shutdown(socket.SHUT_RDWR)
            side.close()

    def _read(self):
        with contextlib.suppress(OSError, ValueError):
            for data in self._link.pieces(self):
                self._queue(data)
        self._queue(b"")

    def _queue(self, data):
        delay = self._link.delay
        for _ in range(0, len(data), SEGMENT):
            if self._link.random.random() < self._link.loss:
                delay += max(RETRANSMISSION, 2.5 * self._link.delay)
        with self._link.changed:
            self._last = max(self._last, time.monotonic() + delay)
            self.chunks.append((self._last, data))
            self._link.changed.notify_all()

    def _write(self):
        while True:
            with self._link.changed:
                self._link.changed.wait_for(lambda: self._is_closed or self._may_write())
                if self._is_closed:
                    return
                due, data = self.chunks[0]
            if (wait := due - time.monotonic()) > 0:
                time.sleep(wait)
            with self._link.changed:
                if not self._may_write():
                    continue
            with contextlib.suppress(OSError):
                if data:
                    self.sink.sendall(data)
                else:
                    self.sink.shutdown(socket.SHUT_WR)
            with self._link.changed:
                self.chunks.popleft()
                self._link.changed.notify_all()
            if not data:
                self.has_ended = True
                self._link.close_ended()
                return

    def _may_write(self):
        is_held = self.answers is None and self._link.holds_answers
        return bool(self.chunks) and not (self.is_forgotten or self._link.is_cut or is_held)
