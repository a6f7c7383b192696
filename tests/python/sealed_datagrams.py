"""Datagrams as docs/design/datagrams.md has them, written from RFC 8439 and RFC 5869 alone, and a robot that sends them."""

import hmac
import itertools
import socket
import struct

from serving import DEADLINE_SECONDS, message_class

MASK = 0xFFFFFFFF
COLUMNS = [(i, i + 4, i + 8, i + 12) for i in range(4)]
QUARTERS = [*COLUMNS, (0, 5, 10, 15), (1, 6, 11, 12), (2, 7, 8, 13), (3, 4, 9, 14)]


def hkdf(key, info):
    """Returns 32 bytes of HKDF-SHA256 without a salt."""
    secret = hmac.digest(bytes(32), key, "sha256")
    return hmac.digest(secret, info + b"\1", "sha256")


def chacha20(key, counter, nonce, data):
    """Returns the data, encrypted or decrypted."""
    out = b""
    for block in range(-(-len(data) // 64)):
        begin = [0x61707865, 0x3320646E, 0x79622D32, 0x6B206574]
        begin += [*struct.unpack("<8I", key), counter + block, *struct.unpack("<3I", nonce)]
        x = list(begin)

        def turn(i, j, k, by, x=x):
            x[i] = (x[i] + x[j]) & MASK
            x[k] ^= x[i]
            x[k] = (x[k] << by | x[k] >> (32 - by)) & MASK

        for _ in range(10):
            for a, b, c, d in QUARTERS:
                for i, j, k, by in ((a, b, d, 16), (c, d, b, 12), (a, b, d, 8), (c, d, b, 7)):
                    turn(i, j, k, by)
        stream = struct.pack("<16I", *((one + two) & MASK for one, two in zip(x, begin, strict=True)))
        out += bytes(one ^ two for one, two in zip(data[64 * block : 64 * block + 64], stream, strict=False))
    return out


def poly1305(key, message):
    """Returns the tag of a message."""
    r, s = (int.from_bytes(key[i : i + 16], "little") for i in (0, 16))
    r &= 0x0FFFFFFC0FFFFFFC0FFFFFFC0FFFFFFF
    sum_ = 0
    for i in range(0, len(message), 16):
        sum_ = (sum_ + int.from_bytes(message[i : i + 16] + b"\1", "little")) * r % ((1 << 130) - 5)
    return ((sum_ + s) & ((1 << 128) - 1)).to_bytes(16, "little")


def tag_of(key, nonce, head, sealed):
    """Returns the tag of an encrypted payload behind its head."""
    parts = [part + bytes(-len(part) % 16) for part in (head, sealed)]
    lengths = struct.pack("<QQ", len(head), len(sealed))
    return poly1305(chacha20(key, 0, nonce, bytes(32)), b"".join(parts) + lengths)


class Robot:
    """One address of a robot, with the channel of a session. `sealer` is the robot at another address, if it has moved."""

    def __init__(self, server, opened, sealer=None):
        channel = opened.datagrams
        host, _, port = channel.endpoint.rpartition(":")
        self.opened, self.session = opened, opened.session_id
        self._request, self._answer = (message_class(server.channel, f"spikeserve.v1.Act{name}") for name in ("Request", "Response"))
        self._id = struct.pack(">Q", channel.key_id)
        self._keys = [hkdf(channel.key, f"spikeserve datagram 1 {end}".encode()) for end in ("robot", "server")]
        self._counters = sealer._counters if sealer else itertools.count()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(DEADLINE_SECONDS)
        self._socket.connect((host, int(port)))

    def sealed(self, number, **fields):
        """Returns the datagram of a request."""
        message = self._request(**{"session_id": self.session} | fields).SerializeToString()
        head = b"\1" + self._id + struct.pack(">Q", next(self._counters))
        nonce = bytes(4) + head[9:]
        sealed = chacha20(self._keys[0], 1, nonce, struct.pack(">Q", number) + message)
        return head + sealed + tag_of(self._keys[0], nonce, head, sealed)

    def send(self, datagram):
        self._socket.send(datagram)

    def receive(self):
        """Returns the number of the request that the next datagram answers, and the answer."""
        datagram = self._socket.recv(2048)
        head, sealed, tag = datagram[:17], datagram[17:-16], datagram[-16:]
        nonce = bytes(4) + head[9:]
        assert head[:9] == b"\1" + self._id and tag == tag_of(self._keys[1], nonce, head, sealed)
        payload = chacha20(self._keys[1], 1, nonce, sealed)
        return struct.unpack(">Q", payload[:8])[0], self._answer.FromString(payload[8:])

    def act(self, number, **fields):
        """Sends a request and returns the answer."""
        self.send(self.sealed(number, **fields))
        answered, answer = self.receive()
        assert answered == number
        return answer

    def has_received(self):
        """Returns whether anything has arrived that was not read."""
        self._socket.setblocking(False)
        try:
            return bool(self._socket.recv(2048))
        except BlockingIOError:
            return False
        finally:
            self._socket.settimeout(DEADLINE_SECONDS)

    def close(self):
        self._socket.close()
