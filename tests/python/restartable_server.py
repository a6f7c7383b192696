"""A real server that a test kills and starts again at the same address."""

import contextlib
import os
import subprocess

from serving import DEADLINE_SECONDS, SHIPPED_POLICIES


class RestartableServer:
    """Its first start picks a free port; later starts use the same one."""

    def __init__(self, *flags):
        self._flags = flags
        self._process = None
        self.address = "127.0.0.1:0"

    def start(self):
        """Starts the server and waits until it listens."""
        self._process = subprocess.Popen(
            [
                os.environ["SPIKESERVE_PROGRAM"],
                f"--policies={SHIPPED_POLICIES}",
                f"--listen={self.address}",
                "--http_listen=",
                *self._flags,
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        line = self._process.stdout.readline()
        assert line.startswith("spikeserve: serving gRPC on "), line
        self.address = line.split()[-1]

    def kill(self):
        """Kills the server without a chance to say goodbye. Its sessions are lost."""
        if self._process is not None:
            self._process.kill()
            self._process.wait(timeout=DEADLINE_SECONDS)
            self._process.stdout.close()
            self._process = None


@contextlib.contextmanager
def restartable_server(*flags):
    """Starts a server and yields it."""
    server = RestartableServer(*flags)
    server.start()
    try:
        yield server
    finally:
        server.kill()
