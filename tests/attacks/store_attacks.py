"""A store that answers with replies that are none: another server of the attacker's machine starts on it."""

import contextlib
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time

from tests.attacks.flood import Sent
from tests.attacks.process import MEGABYTE, MemoryWatch, Process

POLICIES = pathlib.Path(__file__).parents[2] / "deploy" / "policies" / "pendulum"
LIMIT_BYTES = 600 * MEGABYTE  # resident, of the server with all policies that it loads
STOP_SECONDS = 5  # in which SIGTERM ends a server
START_SECONDS = 0.5

REPLIES = {
    "an array of 2^31 - 1": b"*2147483647\r\n",
    "an array of 2^63 - 1": b"*9223372036854775807\r\n",
    "an array of -1": b"*-1\r\n",
    "an array of -2": b"*-2\r\n",
    "a string of 2^63 - 1": b"$9223372036854775807\r\n",
    "a slot of -1": b"*1\r\n*3\r\n:-1\r\n:-1\r\n*2\r\n$9\r\n127.0.0.1\r\n:1\r\n",
    "a slot of 2^63 - 1": (
        b"*1\r\n*3\r\n:0\r\n:9223372036854775807\r\n*2\r\n$9\r\n127.0.0.1\r\n:1\r\n"
    ),
    "zero for ever": b":0\r\n",
    "nested arrays": b"*1\r\n" * 1000,
    "HTTP": b"HTTP/1.1 400 Bad Request\r\n\r\n",
}


class LyingStore:
    """Answers every piece that arrives with one reply."""

    def __init__(self, reply, sent):
        self._reply = reply
        self._sent = sent
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                connection = self._listener.accept()[0]
                self._sent.connections += 1
                threading.Thread(target=self._answer, args=(connection,), daemon=True).start()

    def _answer(self, connection):
        with contextlib.suppress(OSError), connection:
            while connection.recv(1 << 16):
                connection.sendall(self._reply)
                self._sent.bytes += len(self._reply)

    def close(self):
        """Accepts no more."""
        self._listener.close()


def start_on(reply, sent):
    """Starts a server on a store with one reply, asks it to stop, and asserts that it does, in time and memory."""
    store = LyingStore(reply, sent)
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(POLICIES, pathlib.Path(folder) / POLICIES.name)
        server = subprocess.Popen(
            [
                os.environ["SPIKESERVE_PROGRAM"],
                f"--policies={folder}",
                f"--session_store=redis://127.0.0.1:{store.port}",
                "--listen=127.0.0.1:0",
                "--http_listen=",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        with MemoryWatch(Process(server.pid), LIMIT_BYTES), contextlib.suppress(ProcessLookupError):
            with contextlib.suppress(subprocess.TimeoutExpired):
                server.wait(START_SECONDS)
            server.send_signal(signal.SIGTERM)
            try:
                status = server.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                server.kill()
                server.wait()
                status = None
    store.close()
    return status


def replies_of_a_lying_store(_, seconds):
    """Starts servers on a store whose replies have lengths and slots that cannot be, or lead nowhere."""
    sent = Sent()
    end = time.monotonic() + seconds
    for name, reply in REPLIES.items():
        status = start_on(reply, sent)
        assert status is not None, f"{name}: SIGTERM does not end the server within {STOP_SECONDS} s"
        # 1: it has refused the store; -SIGTERM: it had not begun to wait for signals.
        assert status in (0, 1, -signal.SIGTERM), f"{name}: ended with {status}"
    while time.monotonic() < end:
        start_on(REPLIES["zero for ever"], sent)
    return sent
