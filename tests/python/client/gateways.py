"""Starts `python -m spikeserve.gateway`."""

import contextlib
import os
import subprocess
import sys

from serving import DEADLINE_SECONDS


class Address(str):
    """ws://HOST:PORT of a gateway, with its process."""

    def __new__(cls, text, process):
        address = super().__new__(cls, text)
        address.process = process
        return address


@contextlib.contextmanager
def running_gateway(server, *flags, token=""):
    """Starts a gateway of openpi on a free port and yields its Address."""
    environment = os.environ | {"SPIKESERVE_TOKEN": token}
    command = [sys.executable, "-m", "spikeserve.gateway", "--openpi", f"--server={server}", "--listen=127.0.0.1:0"]
    gateway = subprocess.Popen([*command, *flags], stdout=subprocess.PIPE, text=True, env=environment)
    announcement = "spikeserve gateway: serving openpi on "
    try:
        line = gateway.stdout.readline()
        assert line.startswith(announcement), f"stdout: expected {announcement!r}, received {line!r}"
        yield Address(line.removeprefix(announcement).strip(), gateway)
        gateway.terminate()
        assert gateway.wait(timeout=DEADLINE_SECONDS) == 0
    finally:
        gateway.kill()
        gateway.wait()
        gateway.stdout.close()
