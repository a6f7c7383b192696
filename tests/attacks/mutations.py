"""Frames of a good conversation with random changes. The same seed makes the same changes."""

import random

from tests.attacks import frames
from tests.attacks.flood import CLOSE, PAUSE, flood
from tests.attacks.slow_attacks import REFLECTION_REQUEST, call_headers

SEED = 14


def conversation():
    """Returns the frames of a conversation: settings, calls of three kinds, their messages, and their ends."""
    end = frames.END_STREAM
    return [
        frames.settings(initial_window_size=65535, header_table_size=4096),
        frames.window_update(1 << 20),
        frames.frame(frames.SETTINGS, flags=frames.ACK),
        call_headers(frames.HEALTH, 1),
        frames.frame(frames.DATA, frames.framed(b""), end, 1),
        call_headers(frames.REFLECTION, 3, ("grpc-timeout", "10S"), ("x-bytes-bin", "AAEC")),
        frames.frame(frames.DATA, REFLECTION_REQUEST, stream=3),
        frames.frame(frames.DATA, b"\x04" + REFLECTION_REQUEST + b"\0\0\0\0", frames.PADDED, 3),
        frames.frame(frames.PING, b"12345678"),
        frames.frame(frames.PRIORITY, b"\0\0\0\x01\x10", stream=5),
        frames.window_update(1000, 3),
        frames.frame(frames.HEADERS, frames.request(frames.HEALTH)[:20], 0, 5),
        frames.frame(
            frames.CONTINUATION, frames.request(frames.HEALTH)[20:], frames.END_HEADERS, 5
        ),
        frames.frame(frames.DATA, frames.framed(b"")[:3], stream=5),
        frames.frame(frames.DATA, frames.framed(b"")[3:], end, 5),
        frames.frame(frames.DATA, b"", end, 3),
        frames.frame(frames.RST_STREAM, b"\0\0\0\x08", stream=3),
    ]


def mutated(good, source):
    """Returns a conversation with one to three changes: of bits, bytes, lengths, or the order of frames."""
    chosen = list(good)
    for _ in range(source.randint(1, 3)):
        i = source.randrange(len(chosen))
        changed = bytearray(chosen[i] or b"\0")  # an earlier change may have left nothing of the frame
        match source.randrange(6):
            case 0:  # a bit of the header or payload
                changed[source.randrange(len(changed))] ^= 1 << source.randrange(8)
            case 1:  # a byte
                changed[source.randrange(len(changed))] = source.randrange(256)
            case 2:  # the frame ends early
                del changed[source.randrange(len(changed)) :]
            case 3:  # more bytes
                at = source.randrange(len(changed) + 1)
                changed[at:at] = source.randbytes(source.randint(1, 40))
            case 4:  # twice
                changed *= 2
            case 5:  # elsewhere
                j = source.randrange(len(chosen))
                changed, chosen[j] = bytearray(chosen[j]), bytes(changed)
        chosen[i] = bytes(changed)
    return b"".join(chosen)


def mutated_frames(address, seconds, count=20_000):
    """Sends at least `count` frames of changed conversations, each on its own connection, and ends after `seconds`."""
    source = random.Random(SEED)
    good = conversation()
    left = [count]

    def script():
        if left[0] > 0:
            left[0] -= len(good)
            yield frames.PREFACE + mutated(good, source)
        yield PAUSE  # the server reads what was sent, and answers
        yield CLOSE

    return flood(address, seconds, script, connections=64, enough=lambda: left[0] <= 0)
