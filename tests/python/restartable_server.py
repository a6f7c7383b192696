"""A real server that a test kills and starts again at the same address."""

import contextlib
import subprocess

from serving import running_server


class RestartableServer:
    """Its first start picks a free port of `host`; later starts use the same one.

    `prefix` is a command that runs the server in its own process, such as nsenter. The server has an HTTP port, at
    `http_address`, if `http` is true, and takes datagrams that come through `relay`, a DatagramRelay.
    """

    def __init__(self, *flags, host="127.0.0.1", prefix=(), http=False, relay=None):
        self._flags, self._relay = list(flags), relay
        if relay is not None:
            self._flags += ["--datagram_listen=127.0.0.1:0", f"--datagram_advertise={relay.address}"]
        self._prefix = prefix
        self._running = contextlib.ExitStack()
        self.server = None  # the Server, while it runs
        self.address = f"{host}:0"
        self.http_address = f"{host}:0" if http else ""

    def start(self):
        """Starts the server and waits until it listens."""
        flags = [f"--listen={self.address}", f"--http_listen={self.http_address}", *self._flags]
        started = running_server(flags=flags, log=subprocess.DEVNULL, prefix=self._prefix)
        self.server = self._running.enter_context(started)
        self.address, self.http_address = self.server.grpc, self.server.http
        if self._relay is not None:
            self._relay.target = self.server.datagrams

    @property
    def pid(self):
        return self.server.process.pid

    def kill(self):
        """Kills the server without a chance to say goodbye. Its sessions are lost."""
        if self.server is not None:
            self.server.kill()
            self.server = None
            self._running.close()

    def stop(self):
        """Keeps the server from running until `resume`. Returns when all of its threads have stopped."""
        self.server.stop()

    def resume(self):
        """Lets a stopped server run again."""
        self.server.resume()

    def restart(self):
        """Ends the server in order, by SIGTERM, and starts it again."""
        self._running.close()
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
