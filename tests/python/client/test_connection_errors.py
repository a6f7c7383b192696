"""Clients say why a server cannot be reached, and a server why it cannot listen."""

import asyncio
import contextlib
import os
import socket
import subprocess
import threading

import grpc
import pytest
import spikeserve
from security import make_authority, make_certificate, tls_flags
from serving import DEADLINE_SECONDS, SHIPPED_POLICIES, running_server

EXPECTS_TLS = "the server expects TLS, and the client does not use it"
NO_TLS = "the server does not speak TLS, and the client uses it"
NOT_ACCEPTED = "that the authority of the client has signed for this host name"
NO_CERTIFICATE = "a certificate of the client"


@contextlib.contextmanager
def silent_port(reply=b""):
    """Yields a port that accepts connections and answers every one with `reply`."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        connections = []

        def serve():
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = listener.accept()
                    connections.append(connection)
                    if reply:
                        connection.recv(1000)
                        connection.sendall(reply)

        threading.Thread(target=serve, daemon=True).start()
        yield f"127.0.0.1:{listener.getsockname()[1]}"
        for connection in connections:
            connection.close()


@pytest.fixture(scope="module")
def encrypted(certificates):
    with running_server(flags=tls_flags(certificates)) as addresses:
        yield addresses


@pytest.fixture(scope="module")
def mutual(certificates):
    with running_server(flags=tls_flags(certificates, f"--tls_client_ca={certificates}/ca.pem")) as addresses:
        yield addresses


@pytest.fixture(scope="module")
def stranger(tmp_path_factory):
    """Returns the folder of an authority that has signed nothing of the servers."""
    path = tmp_path_factory.mktemp("stranger")
    make_authority(path, "ca")
    make_certificate(path, "client", "ca")
    return path


@pytest.fixture
def cases(server, encrypted, mutual, certificates, stranger):
    """Returns the address, the authority of the client or None, and the cause of each failure."""
    return {
        "refused": ("127.0.0.1:1", None, "connection refused: no server listens on port 1 of 127.0.0.1"),
        "unresolved": ("no.such.host.invalid:50051", None, "the host name no.such.host.invalid cannot be resolved"),
        "no name": ("no..name:50051", None, "the host name no..name cannot be resolved"),
        "no socket": ("unix:/nowhere.sock", None, "/nowhere.sock: No such file or directory"),
        "status page": (server.http, None, "perhaps it is that of the status page (--http_listen)"),
        "TLS expected": (encrypted.grpc, None, EXPECTS_TLS),
        "no TLS": (server.grpc, certificates, NO_TLS),
        "strange authority": (encrypted.grpc, stranger, NOT_ACCEPTED),
        "no certificate": (mutual.grpc, certificates, NO_CERTIFICATE),
    }


CASES = [
    "refused",
    "unresolved",
    "no name",
    "no socket",
    "status page",
    "TLS expected",
    "no TLS",
    "strange authority",
    "no certificate",
]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("asynchronous", [False, True])
def test_the_python_client_names_the_cause(cases, case, asynchronous):
    address, authority, cause = cases[case]
    credentials = None
    if authority is not None:
        credentials = grpc.ssl_channel_credentials((authority / "ca.pem").read_bytes())
    options = spikeserve.ClientOptions(connect_timeout=0.5)

    async def list_policies():
        async with spikeserve.AsyncClient(address, options, credentials) as client:
            await client.list_policies()

    with pytest.raises(spikeserve.UnavailableError) as error:
        if asynchronous:
            asyncio.run(list_policies())
        else:
            with spikeserve.Client(address, options, credentials) as client:
                client.list_policies()
    assert f"no connection to {address}: " in error.value.message
    assert cause in error.value.message


@pytest.mark.parametrize("reply, cause", [(b"", "it sends nothing"), (b"SSH-2.0-x\r\n", "does not speak gRPC")])
def test_other_protocols_are_named(reply, cause):
    with silent_port(reply) as address:
        options = spikeserve.ClientOptions(connect_timeout=0.5, timeout=0.5)
        with (
            spikeserve.Client(address, options) as client,
            pytest.raises(spikeserve.UnavailableError, match=cause),
        ):
            client.list_policies()


def run(program, *arguments, **environment):
    return subprocess.run(
        [os.environ[program], *arguments],
        capture_output=True,
        text=True,
        timeout=DEADLINE_SECONDS,
        env=os.environ | environment,
    )


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("program", ["SPIKECTL_PROGRAM", "SPIKELOAD_PROGRAM"])
def test_programs_name_the_cause_in_one_line(cases, case, program):
    address, authority, cause = cases[case]
    flags = [f"--server={address}"] + ([] if authority is None else [f"--tls_ca={authority}/ca.pem"])
    ended = run(program, *(["policies"] if program == "SPIKECTL_PROGRAM" else []), *flags)
    assert ended.returncode == 1
    (line,) = ended.stderr.splitlines()  # without the log of gRPC
    assert f"no server could be reached at {address} within 3s: " in line
    assert cause in line


def test_a_token_that_no_header_can_have_is_refused(monkeypatch):
    monkeypatch.setenv("SPIKESERVE_TOKEN", " secret\n")  # as a file has it
    assert spikeserve.ClientOptions().token == "secret"
    for token in ("sec\nret", "s\u00e9cret", "secret\0"):
        with pytest.raises(ValueError, match="^token: expected printable ASCII characters, received others$"):
            spikeserve.ClientOptions(token=token)
    ended = run("SPIKECTL_PROGRAM", "policies", "--server=127.0.0.1:1", SPIKESERVE_TOKEN="sec\nret")
    assert (ended.returncode, ended.stderr.count("\n")) == (1, 1)
    assert "token: expected printable ASCII characters, received others" in ended.stderr


def test_the_environment_names_the_server(server, monkeypatch):
    monkeypatch.setenv("SPIKESERVE_SERVER", server.grpc)
    with spikeserve.Client() as client:
        assert client.server == server.grpc and client.list_policies()
    with spikeserve.AdminClient() as admin:
        assert admin.list_sessions().open_sessions == 0
    assert spikeserve.evaluate("CartPole-v1", episodes=1).mean_return == 500
    assert "cartpole" in run("SPIKECTL_PROGRAM", "policies").stdout
    assert run("SPIKELOAD_PROGRAM", "--duration=0.1", "--sessions=2").returncode == 0
    # A flag wins, and then the variable of the program.
    assert run("SPIKECTL_PROGRAM", "policies", "--server=127.0.0.1:1").returncode == 1
    assert run("SPIKECTL_PROGRAM", "policies", SPIKECTL_SERVER="127.0.0.1:1").returncode == 1
    monkeypatch.setenv("SPIKESERVE_SERVER", "")
    assert spikeserve.Client().server == "127.0.0.1:50051"


def listen(flag, address):
    flags = {"listen": "127.0.0.1:0", "http_listen": ""} | {flag: address}
    arguments = [f"--{name}={value}" for name, value in flags.items()]
    ended = run("SPIKESERVE_PROGRAM", f"--policies={SHIPPED_POLICIES}", "--insecure_network", *arguments)
    assert ended.returncode == 1
    return ended.stderr.splitlines()[-1]


@pytest.mark.parametrize("flag", ["listen", "http_listen"])
def test_a_server_says_why_it_cannot_listen(server, flag, tmp_path):
    taken = listen(flag, server.grpc)
    assert f"--{flag}: cannot listen on {server.grpc}: Address already in use" in taken
    assert "another program listens there; stop it or choose another address; port 0 picks" in taken
    unresolved = listen(flag, "no.such.host.invalid:50051")
    assert "the host name no.such.host.invalid cannot be resolved: " in unresolved
    assert "it is no address of this machine" in listen(flag, "192.0.2.1:50051")
    if flag == "listen":
        assert "(IPv4 127.0.0.1)" in taken
        missing = listen(flag, f"unix:{tmp_path}/none/socket")
        assert "No such file or directory" in missing


def test_a_server_names_the_family_that_is_taken():
    try:
        taken = socket.create_server(("::1", 0), family=socket.AF_INET6)
    except OSError:
        pytest.skip("this machine has no IPv6")
    with taken:
        address = f"[::1]:{taken.getsockname()[1]}"
        assert "Address already in use (IPv6 ::1): another program" in listen("listen", address)
