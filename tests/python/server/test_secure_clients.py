"""The clients of this repository call a server that requires TLS and tokens."""

import pytest
import spikeserve
from security import OBSERVATION, credentials, tls_flags
from serving import DEADLINE_SECONDS, run, running_server


def test_the_programs_speak_tls_and_send_tokens(certificates, tokens, monkeypatch):
    monkeypatch.delenv("SPIKESERVE_TOKEN", raising=False)
    flags = tls_flags(certificates, f"--tls_client_ca={certificates}/ca.pem", f"--tokens={tokens}")
    with running_server(flags=flags) as addresses:
        security = [
            f"--server={addresses.grpc}",
            f"--tls_ca={certificates}/ca.pem",
            f"--tls_certificate={certificates}/client.pem",
            f"--tls_key={certificates}/client.key",
        ]

        assert "UNAUTHENTICATED" in run("spikectl", "policies", *security, status=1).stderr
        token_file = certificates / "token"
        token_file.write_text("operator\n")
        run("spikectl", "admin", "sessions", f"--token_file={token_file}", *security)
        monkeypatch.setenv("SPIKESERVE_TOKEN", "agent")
        run("spikectl", "policies", *security)
        run("spikectl", "run", "--env=CartPole-v1", *security)
        assert "PERMISSION_DENIED" in run("spikectl", "admin", "drain", *security, status=1).stderr
        run("spikeload", "--duration=200ms", "--sessions=4", "--mode=stream", *security)


def test_the_python_client_speaks_tls_and_sends_tokens(certificates, tokens, monkeypatch):
    monkeypatch.delenv("SPIKESERVE_TOKEN", raising=False)
    with running_server(flags=tls_flags(certificates, f"--tokens={tokens}")) as addresses:
        with (
            spikeserve.Client(addresses.grpc, credentials=credentials(certificates)) as client,
            pytest.raises(spikeserve.SpikeserveError, match="authorization"),
        ):
            client.list_policies()
        options = spikeserve.ClientOptions(token="agent")
        with (
            spikeserve.Client(addresses.grpc, options, credentials(certificates)) as client,
            client.open_session("cartpole") as session,
        ):
            assert session.act(OBSERVATION).step == 0
            with client.act_stream() as stream:
                assert stream.act(session, OBSERVATION, 0.0, timeout=DEADLINE_SECONDS).step == 1
        monkeypatch.setenv("SPIKESERVE_TOKEN", "rival")
        with spikeserve.Client(addresses.grpc, credentials=credentials(certificates)) as client:
            assert client.list_policies()
