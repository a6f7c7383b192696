#!/usr/bin/env python3
"""Measures what one connection of a stranger occupies in the server, in plain text and with TLS.

Opens connections that make one call without a token, whose headers fill the table of HPACK, and prints the growth of the
server's resident memory for each connection, in KiB: with the call open, and after it was answered and the connection
has been idle for some seconds. server/transport/connection_table.h and socket.cc have the figures that the server counts.

    build/venv/bin/python lab/bench/connection_memory.py --server=build/release/bin/spikeserve
"""

import argparse
import os
import pathlib
import socket
import ssl
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python")]

from security import make_authority, make_certificate, tls_flags  # noqa: E402
from serving import running_server  # noqa: E402

from tests.attacks import frames  # noqa: E402
from tests.attacks.process import Process  # noqa: E402

IDLE_SECONDS = 4  # in which the server gives back the buffers of idle connections
FILLING = [(f"x-{i:03}", "v" * 24) for i in range(60)]  # 60 entries of 64 bytes: about 4 KiB


def opened(address, tls):
    """Returns a connection that has sent the headers of a call."""
    host, _, port = address.rpartition(":")
    connection = socket.create_connection((host, int(port)))
    if tls:
        context = ssl.create_default_context()
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        context.set_alpn_protocols(["h2"])
        connection = context.wrap_socket(connection)  # the server begins to speak after this
    block = frames.request(frames.REFLECTION)
    block += b"".join(frames.header(*field, indexed=True) for field in FILLING)
    headers = frames.frame(frames.HEADERS, block, frames.END_HEADERS, 1)
    connection.sendall(frames.PREFACE + frames.settings() + headers)
    connection.recv(1 << 16)
    return connection


def measure(connections, tls, folder):
    """Returns KiB for each connection, with an open call and idle."""
    flags = ["--max_idle_unauthenticated=1000000", "--max_connections_per_address=1000000"]
    flags += tls_flags(folder) if tls else []
    with running_server(flags=flags) as addresses:
        process = Process(addresses.process.pid)
        warm = [opened(addresses.grpc, tls) for _ in range(100)]
        before = process.memory()
        held = [opened(addresses.grpc, tls) for _ in range(connections)]
        busy = process.memory()
        for connection in held + warm:
            connection.sendall(frames.frame(frames.DATA, b"", frames.END_STREAM, 1))
        time.sleep(IDLE_SECONDS)
        idle = process.memory()
        for connection in held + warm:
            connection.close()
    return [(memory - before) / 1024 / connections for memory in (busy, idle)]


def main():
    """Prints a line for each protocol."""
    parser = argparse.ArgumentParser(prog="connection_memory.py", description=__doc__)
    parser.add_argument("--server", required=True, help="the program")
    parser.add_argument("--connections", type=int, default=800, help="at a time [800]")
    arguments = parser.parse_args()
    os.environ["SPIKESERVE_PROGRAM"] = arguments.server
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        make_authority(folder, "ca")
        make_certificate(folder, "server", "ca")
        for protocol in ("plain text", "TLS"):
            busy, idle = measure(arguments.connections, protocol == "TLS", folder)
            print(f"{protocol}: {busy:.1f} KiB with a call, {idle:.1f} KiB idle", flush=True)


if __name__ == "__main__":
    main()
