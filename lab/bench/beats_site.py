"""A robot and its servers in two network namespaces, with a link of delay and loss between them. Needs root."""

import os
import subprocess
import tempfile

from restartable_server import RestartableServer
from serving import Server

ROBOT, SERVER = "10.9.0.1", "10.9.0.2"
OPENPI_PORT, REDIS_PORT = 8000, 6379


class Namespace:
    """A network namespace, which a process holds."""

    def __init__(self, stack):
        command = ["unshare", "-n", "sh", "-c", "ip link set lo up; echo; exec sleep infinity"]
        self._holder = subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL)
        stack.callback(self._close)
        self._holder.stdout.readline()
        self.pid = str(self._holder.pid)
        self.prefix = ("nsenter", "-t", self.pid, "-n")

    def run(self, *command):
        subprocess.run([*self.prefix, *command], check=True)

    def _close(self):
        self._holder.kill()
        self._holder.wait()
        self._holder.stdout.close()


class EmulatedLink:
    """Runs link_emulator between two namespaces."""

    def __init__(self, stack, program, robot, server):
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self._process = subprocess.Popen([program, robot.pid, server.pid], **pipes)
        stack.callback(self._close)
        assert self._process.stdout.readline() == "ready\n", "link_emulator: expected root and /dev/net/tun"
        for space, here, there in ((robot, ROBOT, SERVER), (server, SERVER, ROBOT)):
            space.run("ip", "address", "add", here, "peer", there, "dev", "link")
            space.run("ip", "link", "set", "dev", "link", "up")

    def order(self, *words):
        """Gives an order of link_emulator.cc."""
        print(*words, file=self._process.stdin, flush=True)

    def _close(self):
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


class OpenpiServer:
    """A server of openpi's protocol, with the methods of RestartableServer."""

    stop, resume = Server.stop, Server.resume

    def __init__(self, python, script, prefix):
        self._command = [*prefix, str(python), str(script), SERVER, str(OPENPI_PORT)]
        self.process = None
        self.address = f"ws://{SERVER}:{OPENPI_PORT}"

    @property
    def pid(self):
        return self.process.pid

    def start(self):
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        self.process = subprocess.Popen(self._command, stdout=subprocess.PIPE, text=True, env=environment)
        assert self.process.stdout.readline() == "ready\n"

    def kill(self):
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()


class Site:
    """The namespaces of the robots and the servers, and the link, until the end of `stack`, an ExitStack."""

    def __init__(self, stack, emulator):
        self._stack = stack
        self.robot, self.server = Namespace(stack), Namespace(stack)
        self.link = EmulatedLink(stack, emulator, self.robot, self.server)
        self.servers = []

    def start_servers(self, store, prefix):
        """Starts one server with a "file" store or none (""), or two that share a "redis". `prefix` precedes their commands."""
        flags = ["--insecure_network", f"--datagram_listen={SERVER}:0"]
        if store == "file":
            flags += [f"--session_store=file:{self._stack.enter_context(tempfile.TemporaryDirectory())}"]
        if store == "redis":
            self._start_redis()
            flags += [f"--session_store=redis://127.0.0.1:{REDIS_PORT}"]
        for _ in range(2 if store == "redis" else 1):
            self._start(RestartableServer(*flags, host=SERVER, prefix=(*self.server.prefix, *prefix)))
        return ",".join(server.address for server in self.servers)

    def start_openpi(self, python, script):
        self._start(OpenpiServer(python, script, self.server.prefix))
        return self.servers[0].address

    def _start(self, server):
        self._stack.callback(server.kill)
        server.start()
        self.servers.append(server)

    def _start_redis(self):
        command = ["redis-server", "--port", str(REDIS_PORT), "--save", "", "--daemonize", "no"]
        redis = subprocess.Popen([*self.server.prefix, *command], stdout=subprocess.PIPE, text=True)
        self._stack.callback(redis.stdout.close)
        self._stack.callback(redis.wait)
        self._stack.callback(redis.kill)
        while "Ready to accept connections" not in redis.stdout.readline():
            assert redis.poll() is None
