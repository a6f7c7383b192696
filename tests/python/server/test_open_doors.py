"""The server does not start without tokens or TLS on a network address, unless a flag allows it."""

import pytest
from serving import refusal_at_start, running_server


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
