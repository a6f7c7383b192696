"""The clients of this repository call a server that requires TLS and tokens."""

import os
import subprocess

import pytest
import spikeserve
from security import OBSERVATION, credentials, tls_flags
from serving import DEADLINE_SECONDS, running_server


def test_the_programs_speak_tls_and_send_tokens(certificates, tokens):
    flags = tls_flags(certificates, f"--tls_client_ca={certificates}/ca.pem", f"--tokens={tokens}")
    with running_server(flags=flags) as addresses:
        security = [
            f"--server={addresses.grpc}",
            f"--tls_ca={certificates}/ca.pem",
            f"--tls_certificate={certificates}/client.pem",
            f"--tls_key={certificates}/client.key",
        ]

        def run(program, *arguments, token=None):
            environment = {**os.environ}
            environment.pop("SPIKESERVE_TOKEN", None)
            if token is not None:
                environment["SPIKESERVE_TOKEN"] = token
            return subprocess.run(
                [os.environ[program], *arguments, *security],
                env=environment,
                check=False,
                capture_output=True,
                text=True,
                timeout=DEADLINE_SECONDS,
            )

        assert "UNAUTHENTICATED" in run("SPIKECTL_PROGRAM", "policies").stderr
        assert run("SPIKECTL_PROGRAM", "policies", token="agent").returncode == 0
        played = run("SPIKECTL_PROGRAM", "run", "--env=CartPole-v1", token="agent")
        assert played.returncode == 0, played.stderr
        assert (
            "PERMISSION_DENIED" in run("SPIKECTL_PROGRAM", "admin", "drain", token="agent").stderr
        )
        token_file = certificates / "token"
        token_file.write_text("operator\n")
        listed = run("SPIKECTL_PROGRAM", "admin", "sessions", f"--token_file={token_file}")
        assert listed.returncode == 0, listed.stderr
        load = ["--duration=200ms", "--sessions=4", "--mode=stream"]
        loaded = run("SPIKELOAD_PROGRAM", *load, token="agent")
        assert loaded.returncode == 0, loaded.stderr


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
