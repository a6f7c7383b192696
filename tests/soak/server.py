"""A server to soak, and what it holds: memory, descriptors, threads."""

import contextlib
import dataclasses
import json
import os
import pathlib
import re
import secrets
import shutil
import time

from security import entry, service_with, until
from serving import SHIPPED_POLICIES, page_of, running_server

MEGABYTE = 1 << 20
TENANT = "fleet"
STRANGERS = 500  # tokens that each new token file has, and the one before had not
STABLE_SECONDS = 3.0  # memory that does not fall for so long is what the server needs
SETTLE_SECONDS = 30.0
NOISE = 1 << 14  # bytes that the look itself needs


@dataclasses.dataclass(frozen=True)
class Held:
    """What an idle server holds after a number of decisions."""

    seconds: float
    decisions: int
    memory: int  # bytes that the program has allocated and not freed
    resident: int  # bytes that are not those of files, with those that the allocator keeps
    descriptors: int
    threads: int


class SoakedServer:
    """A server with tokens, recordings and a folder of policies of its own, all below `folder`."""

    def __init__(self, folder):
        self.folder = pathlib.Path(folder)
        self.policies = self.folder / "policies"
        self.recordings = self.folder / "recordings"
        self.tokens = self.folder / "tokens.json"
        self.agent_token = self.folder / "agent.token"
        self.agent_token.write_text("agent")
        self._stack = contextlib.ExitStack()
        self._began = time.monotonic()

    def __enter__(self):
        shutil.copytree(SHIPPED_POLICIES / "cartpole", self.policies / "cartpole")
        self.recordings.mkdir()
        self.write_tokens()
        flags = [
            f"--tokens={self.tokens}",
            f"--record_dir={self.recordings}",
            f"--policy_settings={self.folder}/settings.json",
            "--session_ttl=10s",
            "--compact_after=1s",
        ]
        started = running_server(self.policies, flags, log=self.folder / "server.log")
        self.addresses = self._stack.enter_context(started)
        return self

    def __exit__(self, *error):
        self._stack.__exit__(*error)

    def write_tokens(self):
        """Replaces the token file by one with other tokens beside those that the soak uses."""
        known = [entry("agent", "agent", TENANT), entry("operator", "operator", TENANT)]
        strangers = [entry(secrets.token_hex(), "agent", TENANT) for _ in range(STRANGERS)]
        following = self.folder / ".tokens.json"
        # The soak calls as often as it can, which is above the rates of a tenant.
        rates = {"calls_per_second": dict.fromkeys(("light", "listing", "explain", "operator"), 0)}
        following.write_text(json.dumps({"tenants": {TENANT: rates}, "tokens": known + strangers}))
        following.rename(self.tokens)

    def service(self, token, name):
        """Returns a context with a client of a service."""
        return service_with(self.addresses, token, name)

    def page(self, path):
        return page_of(self.addresses, path, "operator")

    def _metric(self, name):
        values = re.findall(rf"^{name}(?:{{[^}}]*}})? (\S+)$", self.page("/metrics"), re.MULTILINE)
        return sum(map(float, values))

    def _status(self, key):
        return int(re.search(rf"^{key}:\s+(\d+)", self._process_file("status"), re.MULTILINE)[1])

    def _process_file(self, name):
        return pathlib.Path(f"/proc/{self.addresses.process.pid}/{name}").read_text()

    def _memory(self):
        return int(self._metric("spikeserve_allocated_bytes"))

    def held(self):
        """Waits until the server is idle and frees no more memory. Returns what it holds then."""
        until(lambda: self._metric("spikeserve_sessions") == 0)
        least, least_at = self._memory(), time.monotonic()
        deadline = least_at + SETTLE_SECONDS
        while time.monotonic() - least_at < STABLE_SECONDS and time.monotonic() < deadline:
            time.sleep(0.2)
            if (memory := self._memory()) < least - NOISE:
                least, least_at = memory, time.monotonic()
        return Held(
            seconds=time.monotonic() - self._began,
            decisions=int(self._metric("spikeserve_decisions_total")),
            memory=least,
            resident=self._status("RssAnon") * 1024,
            descriptors=len(os.listdir(f"/proc/{self.addresses.process.pid}/fd")),
            threads=self._status("Threads"),
        )
