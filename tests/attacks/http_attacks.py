"""Attacks on the HTTP port: bodies that cost more to read than to send, guesses of tokens, pages of many versions."""

import gzip
import json

from tests.attacks.flood import flood

BURST = 60  # requests at a time
GUESSERS = 100
VIEWERS = 8
LONG_BODY = gzip.compress(
    json.dumps(
        {
            "inputs": [{"name": "observation", "shape": [4], "datatype": "FP32", "data": [0] * 1_300_000}],
            "parameters": {"sequence_id": "a", "sequence_start": True},
        }
    ).encode()
)


def requests_of(head, body=b""):
    """Returns a script that sends one request; the server closes the connection after its answer."""
    lines = [*head, "Host: localhost", "", ""]
    return lambda: iter(["\r\n".join(lines).encode() + body])


def long_body(token):
    """Returns the script of a body of 4 KB that stands for 4 MB of JSON."""
    head = [
        "POST /v2/models/cartpole/infer HTTP/1.1",
        f"Authorization: Bearer {token}",
        "Content-Encoding: gzip",
        f"Content-Length: {len(LONG_BODY)}",
    ]
    return requests_of(head, LONG_BODY)


def bodies_beyond_the_rate(address, seconds):
    """Sends bodies that are long once they are decompressed, of a tenant with 5 decisions a second and short messages."""
    return flood(address, seconds, long_body("small"), BURST)


def bodies_of_a_tenant_without_limits(address, seconds):
    """As above, of a tenant whose messages may be long."""
    return flood(address, seconds, long_body("agent"), BURST)


def guesses_of_a_token(address, seconds):
    """Asks for pages with wrong tokens, on 100 connections."""
    head = ["GET /status.json HTTP/1.1", "Authorization: Bearer wrong"]
    return flood(address, seconds, requests_of(head), GUESSERS)


def viewers_of_many_versions(address, seconds):
    """Reads the status page of a server with many versions again and again."""
    head = ["GET /status.json HTTP/1.1", "Authorization: Bearer viewer"]
    return flood(address, seconds, requests_of(head), VIEWERS)
