"""Network namespaces: each replica has its own, with one link to the clients and one to Redis."""

import os
import subprocess
import sys

CLIENTS = "clients"
STORE = "store"
STORE_ADDRESS = "10.2.0.1"  # of Redis, as all replicas reach it
_LINKS = {CLIENTS: 0, STORE: 1}


def enter_own_namespace():
    """Runs this program again in a network namespace of its own, which needs root."""
    if os.environ.get("CHAOS_NAMESPACE"):
        _run("ip", "link", "set", "lo", "up")
        _run("ip", "address", "add", f"{STORE_ADDRESS}/32", "dev", "lo")
        return
    environment = os.environ | {"CHAOS_NAMESPACE": "1"}
    command = ["unshare", "-n", sys.executable, "-m", "tests.chaos", *sys.argv[1:]]
    os.execvpe(command[0], command, environment)


def _run(*command):
    subprocess.run(command, check=True)


class Host:
    """The namespace of replica `number`. A process holds it until `close`."""

    def __init__(self, number):
        self._number = number
        self._holder = subprocess.Popen(
            ["unshare", "-n", "sh", "-c", "echo; exec sleep infinity"], stdout=subprocess.PIPE
        )
        self._holder.stdout.readline()  # the namespace exists
        self._inside("ip", "link", "set", "lo", "up")
        for name, network in _LINKS.items():
            outer, inner = f"{name}{number}", f"{name}-in"
            _run("ip", "link", "add", outer, "type", "veth", "peer", "name", inner)
            _run("ip", "link", "set", inner, "netns", str(self._holder.pid))
            _run("ip", "address", "add", f"10.{network}.{number}.1/24", "dev", outer)
            _run("ip", "link", "set", outer, "up")
            self._inside("ip", "address", "add", f"10.{network}.{number}.2/24", "dev", inner)
            self._inside("ip", "link", "set", inner, "up")
        self._route_to_store()

    @property
    def prefix(self):
        """Returns the command that runs a program in the namespace."""
        return ["nsenter", "-t", str(self._holder.pid), "-n"]

    @property
    def address(self):
        """Returns the address at which clients reach the replica."""
        return f"10.{_LINKS[CLIENTS]}.{self._number}.2"

    def cut(self, link):
        """Drops all packets of CLIENTS or STORE until `heal`."""
        self._inside("ip", "link", "set", f"{link}-in", "down")

    def heal(self, link):
        """Ends `cut`."""
        self._inside("ip", "link", "set", f"{link}-in", "up")
        if link == STORE:
            self._route_to_store()

    def close(self):
        """Removes the namespace."""
        self._holder.kill()
        self._holder.wait()
        self._holder.stdout.close()

    def _route_to_store(self):
        self._inside("ip", "route", "replace", STORE_ADDRESS, "via", f"10.{_LINKS[STORE]}.{self._number}.1")

    def _inside(self, *command):
        _run(*self.prefix, *command)
