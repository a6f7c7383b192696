"""Builds frames of HTTP/2 as byte strings, faster than the h2 package and without its checks."""

import functools
import struct

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
DATA, HEADERS, PRIORITY, RST_STREAM, SETTINGS, PING, GOAWAY, WINDOW_UPDATE, CONTINUATION = (
    *range(5),
    *range(6, 10),
)
END_STREAM, END_HEADERS, PADDED = 1, 4, 8
ACK = 1
CANCEL = 8
INITIAL_WINDOW_SIZE = 4
FRAME_BYTES = 16384  # the largest payload that every server takes

POLICY = "/spikeserve.v1.PolicyService/"
HEALTH = "/grpc.health.v1.Health/Check"
REFLECTION = "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo"


def frame(kind, payload=b"", flags=0, stream=0):
    """Returns one frame."""
    return (
        struct.pack(">BHBBI", len(payload) >> 16, len(payload) & 0xFFFF, kind, flags, stream)
        + payload
    )


def settings(**values):
    """Returns a SETTINGS frame with the given values: settings(initial_window_size=0)."""
    codes = {"header_table_size": 1, "initial_window_size": 4, "max_frame_size": 5}
    return frame(
        SETTINGS, b"".join(struct.pack(">HI", codes[name], value) for name, value in values.items())
    )


def window_update(increment, stream=0):
    """Returns a WINDOW_UPDATE frame."""
    return frame(WINDOW_UPDATE, struct.pack(">I", increment), stream=stream)


def integer(value, bits, first=0):
    """Returns an integer as HPACK encodes it behind a prefix of `bits` bits; `first` holds the bits before."""
    limit = (1 << bits) - 1
    if value < limit:
        return bytes([first | value])
    rest, encoded = value - limit, [first | limit]
    while rest >= 128:
        encoded.append(rest & 127 | 128)
        rest >>= 7
    return bytes([*encoded, rest])


def text(value):
    """Returns a string as HPACK encodes it without Huffman's code."""
    value = value if isinstance(value, bytes) else value.encode()
    return integer(len(value), 7) + value


def header(name, value, indexed=False):
    """Returns a header as a literal; `indexed` adds it to the dynamic table."""
    return (b"\x40" if indexed else b"\x00") + text(name) + text(value)


def call_fields(path):
    """Returns the headers of a gRPC call, without :method and :scheme."""
    return [
        (":path", path),
        (":authority", "localhost"),
        ("te", "trailers"),
        ("content-type", "application/grpc"),
    ]


def request(path, *more):
    """Returns the header block of a gRPC call. `more` are further headers as (name, value)."""
    return b"\x83\x86" + b"".join(
        header(*field) for field in [*call_fields(path), *more]
    )  # POST, http


def indexed_request(path):
    """Returns two header blocks: one that enters a gRPC call into the dynamic table, and one that repeats it."""
    first = b"\x83\x86" + b"".join(header(*field, indexed=True) for field in call_fields(path))
    return first, b"\x83\x86\xc1\xc0\xbf\xbe"  # dynamic entries 65 to 62, of which 62 is the newest


def framed(message):
    """Returns a gRPC message with its prefix."""
    return struct.pack(">BI", 0, len(message)) + message


def streams(first, count):
    """Returns `count` stream identifiers of a client from the stream numbered `first` on."""
    return range(2 * first + 1, 2 * (first + count), 2)


@functools.cache
def repeated(block, first, count, reset=False, flags=END_HEADERS):
    """Returns HEADERS frames with the same block on `count` new streams; `reset`: each followed by RST_STREAM."""
    head = frame(HEADERS, block, flags)[:5]
    if not reset:
        return b"".join(
            head + struct.pack(">I", stream) + block for stream in streams(first, count)
        )
    end = frame(RST_STREAM, struct.pack(">I", CANCEL))
    return b"".join(
        head + (number := struct.pack(">I", stream)) + block + end[:5] + number + end[9:]
        for stream in streams(first, count)
    )
