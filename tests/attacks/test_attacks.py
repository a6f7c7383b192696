"""What a stranger without a token, or another tenant, sends leaves the server's memory and its neighbours as they were."""

import re

import pytest
from server_fixtures import certificates, tokens  # noqa: F401
from serving import running_server

from tests.attacks import frames, http2_attacks
from tests.attacks.catalogue import ATTACKS
from tests.attacks.flood import CLOSE, flood
from tests.attacks.observation import SERVED_SECONDS, Rounds, observe
from tests.attacks.process import MEGABYTE

ATTACK_SECONDS = 0.8
IDLE_SECONDS = 0.2
LINES_A_SECOND = 10  # of one kind
PEAK_LIMIT = 150 * MEGABYTE
RETURN_LIMIT = 20 * MEGABYTE


@pytest.mark.parametrize("name", ATTACKS)
def test_the_server_outlives(name, tokens, certificates):
    attack = ATTACKS[name]
    seen = observe(attack, tokens, certificates, Rounds(1, ATTACK_SECONDS, IDLE_SECONDS), RETURN_LIMIT)
    print(seen)
    assert seen.alive, "the server has ended, or was killed for its memory"
    assert seen.sent["connections"] > 0
    assert seen.peak < PEAK_LIMIT
    assert seen.after < (3 if attack.gateway else 1) * RETURN_LIMIT  # Python keeps more of what it has freed
    assert seen.served_after is not None, f"no new client was served within {SERVED_SECONDS} s"


def log_of(path, *attacks):
    """Runs attacks, (address, seconds), on a new server. Returns the lines that it logged."""
    with running_server(log=path) as addresses:
        host, _, port = addresses.grpc.rpartition(":")
        for attack in attacks:
            assert attack((host, int(port)), ATTACK_SECONDS).connections > 0
    return path.read_bytes().split(b"\n")[:-1]


def test_a_flood_of_refused_connections_does_not_flood_the_log(tmp_path):
    lines = log_of(tmp_path / "log", http2_attacks.rapid_reset)
    closed = [line for line in lines if b"connection closed" in line]
    # The attack may take a little longer than asked for, and begin within a second of the server's.
    assert 0 < len(closed) <= 4 * LINES_A_SECOND, len(closed)


FORGED = b"trailers\r\n2026-01-01T00:00:00Z info forged\x1b[2J"


def test_a_header_forges_no_line_of_the_log(tmp_path):
    """In the header that gRPC's library once logged, in the path, in a binary header and in the token."""

    def script(name):
        fields = [field for field in frames.call_fields(http2_attacks.ACT_STREAM) if field[0] != name]
        block = b"\x83\x86" + b"".join(frames.header(*field) for field in [*fields, (name, FORGED)])
        yield http2_attacks.OPENING + frames.frame(frames.HEADERS, block, frames.END_HEADERS, 1)
        yield CLOSE

    def send(name):
        return lambda address, seconds: flood(address, seconds / 4, lambda: script(name))

    names = ("te", ":path", "x-bin", "authorization")
    lines = log_of(tmp_path / "log", *map(send, names))
    for line in lines:
        assert re.match(rb"\d{4}-\d{2}-\d{2}T[\d:.]+Z (info|warning|error) ", line), line
        assert not re.search(rb"[\x00-\x1f\x7f]", line), line
        assert not line.startswith(b"2026-01-01T00:00:00Z"), line
