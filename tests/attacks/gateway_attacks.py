"""Attacks on the gateway of openpi, which has a token of its own, and robots of two tenants."""

import concurrent.futures
import contextlib
import dataclasses
import itertools

from tests.attacks.flood import PAUSE, Sent, flood
from tests.attacks.tenant_attacks import in_threads
from tests.attacks.websocket import RefusedError, Robot, request

STRANGERS = (
    (),
    ("Authorization: Bearer nope",),
    ("Authorization: Bearer operator",),
    ("Authorization: Api-Key nope",),
    ("Authorization: Api-Key nope", "X-Forwarded-For: 127.0.0.1"),
    ("Authorization: Api-Key ", "Authorization: Api-Key agent"),
)
GUESSERS, CROWD = 4, 10
ROBOTS = 3
CONNECTIONS = 4
PAUSES = 20  # until a request is answered
LARGEST = 1 << 20  # bytes of a message
# Short maps, lists in lists, and one long text, where a robot sends what it observes.
MANY_MAPS = b"\xdd\x00\x04\x00\x00" + b"\x82\xa1a\x01\xa1b\x02" * (LARGEST // 7 - 1)
NESTED_LISTS = b"\xdc\x10\x00" + (b"\xdc\x10\x00" + b"\x90" * 4096) * (LARGEST // 4100)
LONG_KEY = b"\x81\xdb\x00\x0f\x00\x00" + b"x" * (15 << 16) + b"\x00"
LONGEST_ERROR = 2000  # bytes
PING = b"\x89\x80" + bytes(4)
BEGINNING, FRAGMENT = b"\x02\x80" + bytes(4), b"\x00\x80" + bytes(4)  # of a message that never ends
FRAMES = 50_000  # at a time


class LentError(Exception):
    """The gateway has let a stranger in."""


def strangers_at_the_gateway(address, seconds):
    """Asks for connections without a token, with those of nobody, and in other forms. None is to be had.

    Four at a time wait for their answers, and a crowd with a token each does not.
    """
    sent = Sent()
    number = itertools.count()

    def script():
        return iter([request(f"Authorization: Api-Key nope{next(number)}")])

    def ask(is_over):
        for headers in itertools.cycle(STRANGERS):
            if is_over():
                return
            sent.connections += 1
            with contextlib.suppress(RefusedError), Robot(address, *headers):
                raise LentError(headers)

    with concurrent.futures.ThreadPoolExecutor(1) as thread:
        crowd = thread.submit(flood, address, seconds, script, CROWD)
        in_threads(GUESSERS, seconds, ask)
    return dataclasses.replace(crowd.result(), connections=crowd.result().connections + sent.connections)


def send_again(address, seconds, messages):
    """Sends messages that are refused on three connections, each as soon as the one before is answered."""
    sent = Sent(connections=ROBOTS)

    def send(is_over):
        with Robot(address, "Authorization: Api-Key agent") as robot:
            while not is_over():
                for message in messages:
                    assert len(robot.call(message)) < LONGEST_ERROR
                    sent.bytes += len(message)

    in_threads(ROBOTS, seconds, send)
    return sent


def messages_of_many_values(address, seconds):
    """Sends messages of 1 MiB whose values take many times as much."""
    return send_again(address, seconds, [MANY_MAPS, NESTED_LISTS[:LARGEST]])


def errors_of_long_texts(address, seconds):
    """Sends messages of 1 MB that an error could repeat."""
    return send_again(address, seconds, [LONG_KEY])


def frames_of_nothing(address, seconds):
    """Sends pings, and fragments without bytes of a message without an end: some before the request is answered."""
    kinds = itertools.cycle(itertools.product([(b"", PING), (BEGINNING, FRAGMENT)], [0, PAUSES]))

    def script():
        (first, frame), pauses = next(kinds)
        yield request("Authorization: Api-Key agent")
        yield from itertools.repeat(PAUSE, pauses)
        yield first
        yield from itertools.repeat(frame * FRAMES)

    return flood(address, seconds, script, CONNECTIONS)
