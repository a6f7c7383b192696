"""Says why a server cannot be reached, by trying the steps of a connection one after the other.

gRPC reports one status for all causes, and its text differs from version to version.
"""

from __future__ import annotations

import contextlib
import re
import socket
import ssl

_SECONDS = 2.0  # for each step
_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])
_SETTINGS_FRAME = 4
_TLS_RECORDS = (0x15, 0x16)  # alert, handshake


def diagnose(server: str, tls: bool, message: str) -> str | None:
    """Returns why `server`, "HOST:PORT" or "unix:PATH", cannot be reached; None: it can be.

    `tls` shows whether the client encrypts. `message` is the one of gRPC.
    """
    try:
        with contextlib.closing(_connect(server)) as connection:
            connection.settimeout(_SECONDS)
            reason = _check_tls(connection) if tls else _check_plain(connection)
    except _UnreachableError as error:
        return str(error)
    except OSError:
        reason = None
    if reason is None and not tls and _speaks_tls(server):
        return _EXPECTS_TLS
    if reason is None and tls and re.search("certificate", message, re.IGNORECASE):
        return (
            "the certificate of the server is not accepted: expected one that the authority of the "
            "client has signed for this host name"
        )
    return reason


_EXPECTS_TLS = "the server expects TLS, and the client does not use it"


class _UnreachableError(Exception):
    """No connection can be made. The text has the reason."""


def _connect(server: str) -> socket.socket:
    if server.startswith("unix:"):
        path = re.sub("^unix:(//)?", "", server)
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(path)
        except OSError as error:
            raise _UnreachableError(f"{path}: {error.strerror}") from None
        return connection
    host, _, port = re.sub("^dns:(///)?", "", server).rpartition(":")
    host = host.strip("[]")
    if not host or not port.isdigit():
        raise _UnreachableError(f"server: expected HOST:PORT or unix:PATH, received {server}")
    try:
        addresses = socket.getaddrinfo(host, int(port), type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:  # UnicodeError: a name that DNS cannot have
        text = getattr(error, "strerror", None) or str(error)
        raise _UnreachableError(f"the host name {host} cannot be resolved: {text}") from None
    reason = ""
    for family, kind, protocol, _, address in addresses:
        connection = socket.socket(family, kind, protocol)
        connection.settimeout(_SECONDS)
        try:
            connection.connect(address)
        except TimeoutError:
            reason = f"no answer within {_SECONDS:g} s; a firewall may block port {port}"
        except ConnectionRefusedError:
            reason = f"connection refused: no server listens on port {port} of {host}"
        except OSError as error:
            reason = error.strerror or str(error)
        else:
            return connection
        connection.close()
    raise _UnreachableError(reason)


def _check_plain(connection: socket.socket) -> str | None:
    try:
        connection.sendall(_PREFACE)
        reply = connection.recv(9)
    except TimeoutError:
        return "the port accepts connections and does not speak gRPC: it sends nothing"
    if len(reply) > 3 and reply[3] == _SETTINGS_FRAME:
        return None
    if reply.startswith(b"HTTP/1"):
        return (
            "the port speaks HTTP/1 and not gRPC: perhaps it is that of the status page "
            "(--http_listen)"
        )
    if reply and reply[0] in _TLS_RECORDS:
        return _EXPECTS_TLS
    return "the port does not speak gRPC" if reply else None


def _check_tls(connection: socket.socket) -> str | None:
    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    context.set_alpn_protocols(["h2"])
    try:
        with context.wrap_socket(connection) as encrypted:
            encrypted.settimeout(0.5)
            with contextlib.suppress(TimeoutError):
                encrypted.recv(1)  # with TLS 1.3, the server judges the client after the handshake
    except ssl.SSLError as error:
        if "CERTIFICATE_REQUIRED" in str(error) or "HANDSHAKE_FAILURE" in str(error):
            return "the server requires a certificate of the client"
        if "ALERT" in str(error):
            return f"the server refused the TLS connection: {error.reason}"
        return "the server does not speak TLS, and the client uses it"
    except TimeoutError:
        return "the server does not speak TLS, and the client uses it"
    return None


def _speaks_tls(server: str) -> bool:
    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    try:
        with contextlib.closing(_connect(server)) as connection:
            connection.settimeout(_SECONDS)
            with context.wrap_socket(connection):
                return True
    except ssl.SSLError as error:
        return "ALERT" in str(error)
    except (OSError, _UnreachableError):
        return False
