"""A real server that a test kills and starts again at the same address."""

import contextlib
import os
import signal
import subprocess

from serving import DEADLINE_SECONDS, SHIPPED_POLICIES


class RestartableServer:
    """Its first start picks a free port of `host`; later starts use the same one.

    `prefix` is a command that runs the server in its own process, such as nsenter. The server has an HTTP port, at
    `http_address`, if `http` is true.
    """

    def __init__(self, *flags, host="127.0.0.1", prefix=(), http=False):
        self._flags = flags
        self._prefix = prefix
        self._process = None
        self.address = f"{host}:0"
        self.http_address = f"{host}:0" if http else ""

    def start(self):
        """Starts the server and waits until it listens."""
        self._process = subprocess.Popen(
            [
                *self._prefix,
                os.environ["SPIKESERVE_PROGRAM"],
                f"--policies={SHIPPED_POLICIES}",
                f"--listen={self.address}",
                f"--http_listen={self.http_address}",
                *self._flags,
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self.address = self._announced("gRPC")
        if self.http_address:
            self.http_address = self._announced("HTTP")

    def _announced(self, protocol):
        line = self._process.stdout.readline()
        assert line.startswith(f"spikeserve: serving {protocol} on "), line
        return line.split()[-1]

    @property
    def pid(self):
        return self._process.pid

    def kill(self):
        """Kills the server without a chance to say goodbye. Its sessions are lost."""
        if self._process is not None:
            self._process.kill()
            self._process.wait(timeout=DEADLINE_SECONDS)
            self._process.stdout.close()
            self._process = None

    def stop(self):
        """Keeps the server from running until `resume`. Returns when all of its threads have stopped."""
        self._process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, self._process.pid, os.WSTOPPED)

    def resume(self):
        """Lets a stopped server run again."""
        self._process.send_signal(signal.SIGCONT)

    def restart(self):
        """Ends the server in order, by SIGTERM, and starts it again."""
        self._process.terminate()
        assert self._process.wait(timeout=DEADLINE_SECONDS) == 0
        self._process.stdout.close()
        self.start()


@contextlib.contextmanager
def restartable_server(*flags):
    """Starts a server and yields it."""
    server = RestartableServer(*flags)
    server.start()
    try:
        yield server
    finally:
        server.kill()
