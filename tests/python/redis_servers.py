"""Starts real Redis servers: alone, over TLS, with Sentinels, and as a Cluster."""

import contextlib
import pathlib
import re
import shutil
import signal
import socket
import ssl
import subprocess
import tempfile

import pytest
from security import make_authority, make_certificate, until

PASSWORD = "secret"
# Keeps its keys when it is killed and started again. With "everysec" it would acknowledge writes that it holds back for
# up to two seconds while its disk is slow.
DURABLE = ("--appendonly", "yes", "--appendfsync", "always")
SLOTS = 16384
WITHOUT_REDIS = pytest.mark.skipif(shutil.which("redis-server") is None, reason="without redis-server")


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def read_reply(lines):
    """Reads one reply of the protocol. An error is returned as its text."""
    kind, rest = (line := lines.readline())[:1], line[1:].strip()
    if kind == b"$":
        return None if rest == b"-1" else lines.read(int(rest) + 2)[:-2]
    if kind == b"*":
        return [read_reply(lines) for _ in range(int(rest))]
    return int(rest) if kind == b":" else rest


class Redis:
    """A Redis server. `certificates`: the folder of make_certificates(), for TLS.

    It forgets everything when it is killed, unless `flags` has DURABLE.
    """

    def __init__(self, *flags, password=PASSWORD, certificates=None, host="127.0.0.1"):
        self.port = free_port()
        self.password = password
        self.certificates = certificates
        port = ["--port", str(self.port)]
        if certificates is not None:
            port = [
                *("--port", "0", "--tls-port", str(self.port)),
                *("--tls-cert-file", f"{certificates}/server.pem", "--tls-key-file", f"{certificates}/server.key"),
                *("--tls-ca-cert-file", f"{certificates}/ca.pem", "--tls-auth-clients", "yes"),
            ]
        self.folder = tempfile.TemporaryDirectory()  # a replica writes what it gets from its primary
        secret = ["--requirepass", password, "--masterauth", password] if password else []
        self.program = [
            *("redis-server", "--bind", host, "--protected-mode", "no", *port),
            *("--save", "", "--appendonly", "no", "--dir", self.folder.name, *secret, *flags),
        ]
        self.start()

    def start(self):
        self.process = subprocess.Popen(self.program, stdout=subprocess.DEVNULL)
        until(lambda: self.command("PING") == b"PONG")

    def connect(self):
        connection = socket.create_connection(("127.0.0.1", self.port))
        if self.certificates is None:
            return connection
        context = ssl.create_default_context(cafile=self.certificates / "ca.pem")
        context.load_cert_chain(self.certificates / "client.pem", self.certificates / "client.key")
        return context.wrap_socket(connection, server_hostname="localhost")

    def command(self, *words, database=0):
        """Returns the reply, or None if the server does not answer."""
        with contextlib.suppress(OSError), self.connect() as connection:
            setup = [f"AUTH {self.password}"] if self.password else []
            setup += [f"SELECT {database}"] if database else []
            connection.sendall(("\r\n".join([*setup, " ".join(words)]) + "\r\n").encode())
            lines = connection.makefile("rb")
            for _ in setup:
                assert read_reply(lines) == b"OK"
            return read_reply(lines)
        return None

    def replace_by(self, other):
        """Goes on with the process and the files of `other`, which listens at this port now."""
        self.folder.cleanup()
        self.process, self.folder = other.process, other.folder
        at = self.program.index("--dir") + 1
        self.program[at] = self.folder.name

    def kill(self):
        self.process.kill()
        self.process.wait()

    def stop(self):
        self.process.send_signal(signal.SIGCONT)
        self.kill()


class Files:
    """The append-only file of a Redis server at some moment."""

    def __init__(self, redis):
        self.redis = redis
        self.now = pathlib.Path(redis.folder.name) / "appendonlydir"
        shutil.copytree(self.now, self.now.with_name("before"))

    def restore(self):
        """Redis starts again with the files of that moment."""
        self.redis.kill()
        shutil.rmtree(self.now)
        self.now.with_name("before").rename(self.now)
        self.redis.start()


@contextlib.contextmanager
def stopping(servers):
    """Yields `servers`, a list that may grow, and stops them all."""
    try:
        yield servers
    finally:
        for server in servers:
            server.stop()


def make_certificates(path):
    make_authority(path, "ca")
    make_authority(path, "stranger")
    make_certificate(path, "server", "ca")
    make_certificate(path, "client", "ca")
    return path


class Sentinel:
    """Watches a primary. With `quorum` others it decides that one is away which is silent for `silence` milliseconds."""

    def __init__(self, folder, primary, quorum, silence=500):
        self.port = free_port()
        file = folder / f"sentinel-{self.port}.conf"
        file.write_text(
            f"bind 127.0.0.1\nport {self.port}\ndir {folder}\n"
            f"sentinel monitor mymaster 127.0.0.1 {primary.port} {quorum}\n"
            f"sentinel auth-pass mymaster {PASSWORD}\n"
            f"sentinel down-after-milliseconds mymaster {silence}\nsentinel failover-timeout mymaster 2000\n"
        )
        self.process = subprocess.Popen(["redis-server", str(file), "--sentinel"], stdout=subprocess.DEVNULL)

    password = None
    certificates = None
    connect = Redis.connect
    command = Redis.command
    stop = Redis.stop
    kill = Redis.kill


def primary_port(sentinel):
    """Returns the port of the primary that a Sentinel names."""
    reply = sentinel.command("SENTINEL get-master-addr-by-name mymaster")
    return int(reply[1]) if isinstance(reply, list) else None


def is_watched(sentinel, replicas, sentinels):
    """Returns whether a Sentinel knows so many replicas of the primary and so many other Sentinels."""
    fields = sentinel.command("SENTINEL MASTER mymaster")
    if not isinstance(fields, list):
        return False  # it does not answer yet
    state = dict(zip(fields[::2], fields[1::2], strict=True))
    return (int(state[b"num-slaves"]), int(state[b"num-other-sentinels"])) == (replicas, sentinels)


def start_cluster(servers, nodes=3, flags=(), **options):
    """Starts the nodes of a Cluster, adds them to `servers`, and divides the slots evenly."""
    for _ in range(nodes):
        servers.append(Redis("--cluster-enabled", "yes", "--cluster-port", str(free_port()), *flags, **options))
    first = servers[0]
    for i, server in enumerate(servers):
        begin, end = SLOTS * i // nodes, SLOTS * (i + 1) // nodes - 1
        assert server.command(f"CLUSTER ADDSLOTSRANGE {begin} {end}") == b"OK"
        server.command(f"CLUSTER SET-CONFIG-EPOCH {i + 1}")
        if server is not first:
            port = bus_port(first)
            assert server.command(f"CLUSTER MEET 127.0.0.1 {first.port} {port}") == b"OK"
    until(lambda: all(b"cluster_state:ok" in server.command("CLUSTER INFO") for server in servers))
    until(lambda: all(len(server.command("CLUSTER SLOTS")) == nodes for server in servers))


def bus_port(server):
    return int(server.command("CONFIG GET cluster-port")[1])


def node_id(server):
    return server.command("CLUSTER MYID").decode()


def epoch_of(server):
    """Returns the newest configuration of the cluster that a node knows of."""
    return re.search(rb"cluster_current_epoch:(\d+)", server.command("CLUSTER INFO"))[1]


def move_slot(slot, source, target, servers, finish=True, keys=None):
    """Moves the keys of a slot, all or `keys`, and then the slot if `finish`, as redis-cli --cluster reshard does.

    A target that has not heard of the last move takes no newer epoch than the source, and gives the slot back to it when
    they talk next. Then each says for ever that the other one has the slot.
    """
    until(lambda: len({epoch_of(server) for server in servers}) == 1)
    target.command(f"CLUSTER SETSLOT {slot} IMPORTING {node_id(source)}")
    source.command(f"CLUSTER SETSLOT {slot} MIGRATING {node_id(target)}")
    while moving := keys or source.command(f"CLUSTER GETKEYSINSLOT {slot} 100"):
        for key in moving:
            secret = f" AUTH {target.password}" if target.password else ""
            moved = source.command(f"MIGRATE 127.0.0.1 {target.port} {key.decode()} 0 1000{secret}")
            assert moved == b"OK", moved
        if keys:
            break
    for server in (target, source, *servers) if finish else ():
        server.command(f"CLUSTER SETSLOT {slot} NODE {node_id(target)}")
