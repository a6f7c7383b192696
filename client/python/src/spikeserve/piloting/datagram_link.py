"""`DatagramLink`: the steps of a pilot as sealed datagrams, docs/design/datagrams.md."""

from __future__ import annotations

import contextlib
import hmac
import importlib
import itertools
import selectors
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

from spikeserve.wire import METHODS, Message

ciphers: Any
try:
    ciphers = importlib.import_module("cryptography.hazmat.primitives.ciphers.aead")
except ImportError:
    ciphers = None

_VERSION = 1
_HEAD = struct.Struct(">BQQ")  # version, id of the key, counter
_NUMBER = struct.Struct(">Q")  # of the request
_KEY_BYTES = 32
_MOST_BYTES = 1200
_WINDOW = 1024  # counters behind the newest one that are not replays yet
_LOOK_SECONDS = 0.1  # until a thread notices that it is not wanted any more
_TRY_AGAIN_SECONDS = 1.0  # to find a server whose name was not found


def require_ciphers() -> None:
    """Raises ImportError if nothing here can seal datagrams."""
    if ciphers is None:
        raise ImportError(
            "transport: expected the package cryptography for datagram, received none; "
            "pip install cryptography brings it"
        )


class _SealedChannel:
    """The robot's end of a channel: core/datagram/sealed_channel.h in Python."""

    def __init__(self, key_id: int, key: bytes) -> None:
        self.key_id = key_id
        secret = hmac.digest(bytes(_KEY_BYTES), key, "sha256")  # HKDF, RFC 5869
        infos = (f"spikeserve datagram 1 {end}\1".encode() for end in ("robot", "server"))
        keys = (hmac.digest(secret, info, "sha256") for info in infos)
        self._robot, self._server = map(ciphers.ChaCha20Poly1305, keys)
        self._counter = itertools.count()
        self._past = 0  # the counter behind the newest one that has arrived
        self._arrived = 0  # bit i: the i-th one before `_past`

    def seal(self, payload: bytes) -> bytes:
        head = _HEAD.pack(_VERSION, self.key_id, next(self._counter))
        sealed: bytes = self._robot.encrypt(_nonce(head), payload, head)
        return head + sealed

    def open(self, datagram: bytes) -> bytes | None:
        """Returns the payload of a datagram of the server; None if it is none, or a replay."""
        head = datagram[: _HEAD.size]
        _, _, counter = _HEAD.unpack(head)
        newer = counter + 1 - self._past
        if newer <= -_WINDOW or (newer <= 0 and self._arrived >> -newer & 1):
            return None
        try:
            payload: bytes = self._server.decrypt(_nonce(head), datagram[_HEAD.size :], head)
        except Exception:  # cryptography.exceptions.InvalidTag
            return None
        if newer > 0:
            self._arrived = self._arrived << min(newer, _WINDOW) & ((1 << _WINDOW) - 1)
            self._past, newer = counter + 1, 0
        self._arrived |= 1 << -newer
        return payload


def _nonce(head: bytes) -> bytes:
    return bytes(4) + head[9:]


class DatagramLink:
    """Sends requests without waiting. Thread-safe.

    Calls `on_answer` with the number of a request and the answer, on a thread of its own.
    """

    def __init__(self, on_answer: Callable[[int, Message], None]) -> None:
        self._on_answer = on_answer
        self._lock = threading.Lock()
        self._channels: list[_SealedChannel] = []  # the newest one, and that before it
        self._endpoint = ""
        self._socket: socket.socket | None = None  # None: the server is not found
        self._address: Any = None
        self._is_stopped = False

    def set_channel(self, channel: Message) -> bool:
        """Sends on this channel from now on. Returns False if it is not valid, or after `stop`."""
        if len(channel.key) != _KEY_BYTES or ":" not in channel.endpoint:
            return False
        with self._lock:
            if self._is_stopped:
                return False
            former = self._channels[:1]
            self._channels = [_SealedChannel(channel.key_id, channel.key), *former]
            if channel.endpoint != self._endpoint:
                self._endpoint, self._socket = channel.endpoint, None
                run = threading.Thread(
                    target=self._run,
                    args=(channel.endpoint,),
                    name="spikeserve-pilot-datagrams",
                    daemon=True,
                )
                run.start()
        return True

    def send(self, number: int, request: Message, copies: int) -> None:
        """Sends a request `copies` times. It is lost if the server is not found yet."""
        payload = _NUMBER.pack(number) + request.SerializeToString()
        with self._lock, contextlib.suppress(OSError):  # the buffer is full, or there is no route
            if self._socket is None:
                return
            for _ in range(copies):
                self._socket.sendto(self._channels[0].seal(payload), self._address)

    def stop(self) -> None:
        """Sends nothing any more."""
        with self._lock:
            self._is_stopped, self._endpoint, self._socket = True, "", None

    def _run(self, endpoint: str) -> None:
        """Takes the answers of a server, until there is another one."""
        while (found := _find(endpoint)) is None:
            time.sleep(_TRY_AGAIN_SECONDS)
            if endpoint != self._endpoint:
                return
        opened, address = found
        with opened, selectors.DefaultSelector() as selector:
            selector.register(opened, selectors.EVENT_READ)
            with self._lock:
                if endpoint == self._endpoint:
                    self._socket, self._address = opened, address
            while self._socket is opened:
                with contextlib.suppress(OSError):
                    if selector.select(_LOOK_SECONDS):
                        self._receive(opened.recv(_MOST_BYTES + 1))

    def _receive(self, datagram: bytes) -> None:
        if len(datagram) < _HEAD.size or len(datagram) > _MOST_BYTES:
            return
        version, key_id, _ = _HEAD.unpack_from(datagram)
        with self._lock:
            named = [each for each in self._channels if each.key_id == key_id]
            payload = named[0].open(datagram) if named and version == _VERSION else None
        if payload is None or len(payload) < _NUMBER.size:
            return
        [number] = _NUMBER.unpack_from(payload)
        self._on_answer(number, METHODS["Act"].response.FromString(payload[_NUMBER.size :]))


def _find(endpoint: str) -> tuple[socket.socket, Any] | None:
    """Returns a socket for HOST:PORT, and the address; None if there is none now."""
    host, _, port = endpoint.rpartition(":")
    try:
        kind = socket.SOCK_DGRAM
        family, *_, address = socket.getaddrinfo(host.strip("[]"), port, type=kind)[0]
        opened = socket.socket(family, kind)
    except (OSError, UnicodeError):
        return None
    opened.setblocking(False)
    return opened, address
