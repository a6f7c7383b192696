"""A server that cannot start says in one line which flag is wrong; without tokens or TLS it does not listen on a network."""

import pytest
from serving import refusal_at_start, run, running_server

DURATION = "expected a duration such as 250ms, 10s or 1.5m"
RECORDINGS = "--record_dir: expected a directory in which the server can create folders, received"


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--policies=/nonexistent", "--policies: /nonexistent: No such file"),
        ("--listen=50051", '--listen: expected HOST:PORT, received "50051"'),
        *(
            (f"--listen={address}", f'--listen: expected HOST:PORT, received "{address}"')
            for address in ("", ":", ":1", "host", "host:", "host:x", "host:-1", "host:65536", "host:80s")
        ),
        *((f"--listen={address}", "--listen: expected HOST:PORT") for address in ("a b:1", "::1:80", "a,b:1", "[]:1")),
        *((f"--listen={address}", f"--listen: expected --tokens for {address}, ") for address in ("[2001:db8::1]:1", "my-host.invalid:1")),
        ("--http_listen=,:1", "--http_listen: expected HOST:PORT"),
        ("--session_ttl=0s", "--session_ttl: expected at least 1ms"),
        ("--session_ttl=soon", f'--session_ttl: {DURATION}, received "soon"'),
        ("--compact_after=0s", "--compact_after: expected at least 1ms"),
        ("--max_sessions=0", "--max_sessions: expected at least 1"),
        ("--max_message_bytes=0", "--max_message_bytes: expected 1 to"),
        ("--drain_timeout=-1s", "--drain_timeout: expected"),
        ("extra", 'expected flags alone, received "extra"'),
        ("--unknown=1", "--unknown: expected a flag of spikeserve"),
        # Not even a superuser can create folders in /proc.
        ("--record_dir=/proc", f"{RECORDINGS} /proc"),
        ("--record_dir=/proc/recordings", f"{RECORDINGS} /proc/recordings"),
    ],
)
def test_a_wrong_flag_is_named_in_one_line(flag, message):
    errors = refusal_at_start(flag)
    assert message in errors
    assert errors.count("\n") == 1, errors


def test_policies_are_needed():
    assert "--policies: expected a directory, received none" in run("spikeserve", status=1).stderr


def test_a_taken_port_is_named(server):
    for flag, address in (("--listen", server.grpc), ("--http_listen", server.http)):
        assert f"{flag}: cannot listen on {address}" in refusal_at_start(f"{flag}={address}")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--listen=0.0.0.0:0"], "--listen: expected --tokens for 0.0.0.0:0"),
        (["--listen=0.0.0.0:0", "--tokens={tokens}"], "--listen: expected --tls_certificate"),
        (["--http_listen=0.0.0.0:0"], "--http_listen: expected --tokens"),
        (
            ["--http_listen=0.0.0.0:0", "--tokens={tokens}"],
            "--http_listen: expected --tls_certificate",
        ),
        (["--tls_certificate=missing.pem"], "--tls_key: expected a file"),
        (["--tls_certificate=missing.pem", "--tls_key=missing.key"], "--tls_certificate: cannot read missing.pem"),
        (["--tokens=missing.json"], "--tokens: missing.json: expected a file that can be read"),
    ],
)
def test_an_open_door_is_not_served_by_accident(tmp_path, tokens, flags, message):
    flags = [flag.format(tokens=tokens) for flag in flags]
    said = refusal_at_start("--allow_no_policies", *flags, policies=tmp_path)
    assert f"spikeserve: {message}" in said


def test_an_open_door_is_served_where_it_was_asked_for():
    with running_server(flags=["--listen=0.0.0.0:0", "--insecure_network"]) as addresses:
        assert addresses.grpc.startswith("0.0.0.0:")
