"""A server that takes commands as Redis does and answers with the bytes that a test wants."""

import contextlib
import socketserver
import threading

NIL = b"$-1\r\n"
OK = b"+OK\r\n"
NO_CLUSTER = b"-ERR This instance has cluster support disabled\r\n"
NOTHING = b""  # the command is never answered


def integer(value):
    return b":%d\r\n" % value


def string(value):
    return b"$%d\r\n%s\r\n" % (len(value), value)


def array(*items):
    return b"*%d\r\n%s" % (len(items), b"".join(items))


def primary(command):
    """Answers what a single primary does that has nothing, and whose scripts return 0."""
    answers = {
        b"CLUSTER": NO_CLUSTER,
        b"ROLE": array(string(b"master"), integer(0), array()),
        b"HMGET": array(*[NIL] * (len(command) - 2)),
        b"EVAL": integer(0),
        b"GET": NIL,
        b"PING": string(command[-1]),
    }
    return answers.get(command[0], OK)


class _Connection(socketserver.StreamRequestHandler):
    def handle(self):
        with contextlib.suppress(OSError, ValueError):
            while line := self.rfile.readline():
                command = []
                for _ in range(int(line[1:])):
                    size = int(self.rfile.readline()[1:])
                    command.append(self.rfile.read(size + 2)[:-2])
                self.server.commands.append(command)
                self.wfile.write(self.server.answer(command))


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True


class FakeRedis:
    """Answers each command, a list of bytes, with `answer(command)`. `commands` are those that have arrived."""

    def __init__(self, answer=primary):
        self._server = _Server(("127.0.0.1", 0), _Connection)
        self._server.answer = answer
        self.commands = self._server.commands = []
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def port(self):
        return self._server.server_address[1]

    @property
    def url(self):
        return f"redis://127.0.0.1:{self.port}"

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._server.shutdown()
        self._server.server_close()
