"""Sets the clock days forwards and backwards while agents play. Runs on the machine that __main__.py starts.

After each step every agent continues, what runs at intervals continues, and only tokens expire whose time has come.
"""

import contextlib
import datetime
import itertools
import json
import pathlib
import shutil
import sys
import tempfile
import threading
import time

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests" / "python")]

import grpc  # noqa: E402
from security import POLICY, Bearer, code_of, entry, until  # noqa: E402
from serving import SHIPPED_POLICIES, Service, message_class, page_of, running_server, status_of  # noqa: E402

DAY = 86400.0
STEPS = [3 * DAY, -6 * DAY, 3 * DAY, -0.4 * DAY, -400 * DAY, 400.4 * DAY]
CALLS = 20  # that each agent makes after a step
OBSERVATION = [0.0] * 4


def step_clock(seconds):
    time.clock_settime(time.CLOCK_REALTIME, time.time() + seconds)


class Agents:
    """Agents that play without a pause, each in a thread, until stop()."""

    def __init__(self, address):
        self.calls = {}
        self._stop = threading.Event()
        self._errors = []
        self._channel = grpc.insecure_channel(address)
        self._request = message_class(self._channel, "spikeserve.v1.ActRequest")
        work = (self._act, self._act_stored, self._stream)
        self._threads = [threading.Thread(target=self._run, args=[each], daemon=True) for each in work]
        for thread in self._threads:
            thread.start()

    def stop(self):
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._channel.close()
        assert not self._errors, self._errors

    def wait_for_calls(self):
        before = dict(self.calls)
        for name in ("_act", "_act_stored", "_stream"):
            until(lambda name=name: self._errors or self.calls.get(name, 0) >= before.get(name, 0) + CALLS)
        assert not self._errors, self._errors

    def _run(self, work):
        try:
            for _ in work():
                self.calls[work.__name__] = self.calls.get(work.__name__, 0) + 1
                if self._stop.is_set():
                    return
        except Exception as error:  # wait_for_calls() raises it
            self._errors.append(error)

    def _open(self, **options):
        service = Service(self._channel, POLICY, grpc.intercept_channel(self._channel, Bearer("agent")))
        return service.OpenSession(policy="cartpole", **options).session_id

    def _call(self, kind, name):
        """Returns a call without a deadline, which Python would take from the time of day."""
        method = kind(
            f"/{POLICY}/{name}",
            request_serializer=self._request.SerializeToString,
            response_deserializer=message_class(self._channel, "spikeserve.v1.ActResponse").FromString,
        )
        return lambda requests: method(requests, metadata=[("authorization", "Bearer agent")])

    def _act(self, **options):
        session = self._open(**options)
        act = self._call(self._channel.unary_unary, "Act")
        for step in itertools.count():
            act(self._request(session_id=session, step=step, observation=OBSERVATION))
            yield

    def _act_stored(self):
        return self._act(durability="SYNC")

    def _stream(self):
        session = self._open(durability="ASYNC")
        answered = threading.Semaphore(1)

        def requests():
            for step in itertools.count():
                answered.acquire()
                yield self._request(session_id=session, step=step, observation=OBSERVATION)

        for answer in self._call(self._channel.stream_stream, "ActStream")(requests()):
            assert not answer.HasField("error"), answer
            yield
            answered.release()


class SteppedServer:
    """The server under test, and what it has to do at intervals."""

    def __init__(self, folder):
        self.policies = folder / "policies"
        self.tokens = folder / "tokens.json"
        self._new_tokens = 0
        shutil.copytree(SHIPPED_POLICIES / "cartpole", self.policies / "cartpole")
        self._versions = len(list((self.policies / "cartpole").iterdir()))
        tomorrow = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=1)
        self._entries = [
            entry("agent", "agent"),
            entry("viewer", "viewer"),
            entry("tomorrow", "agent", expires=tomorrow.strftime("%Y-%m-%dT%H:%M:%SZ")),
        ]
        self._expiry = tomorrow.timestamp()
        self._write_tokens()
        self.flags = [f"--tokens={self.tokens}", "--poll_policies=100ms", f"--session_store=file:{folder}/store"]

    def _write_tokens(self):
        following = self.tokens.with_suffix(".next")
        following.write_text(json.dumps({"tenants": {"fleet": {}}, "tokens": self._entries}))
        following.rename(self.tokens)

    def check(self, addresses, channel, idle):
        """Checks that tokens and policies are read again, that an idle session lives, and that pages answer."""

        def service(token):
            return Service(channel, POLICY, grpc.intercept_channel(channel, Bearer(token)))

        assert service("agent").GetSession(session_id=idle).session_id == idle
        expected = grpc.StatusCode.UNAUTHENTICATED if time.time() > self._expiry else grpc.StatusCode.OK
        until(lambda: code_of(service("tomorrow").ListPolicies) == expected)  # Abseil looks every few seconds
        self._new_tokens += 1
        token = f"token-{self._new_tokens}"
        self._entries.append(entry(token, "agent"))
        self._write_tokens()
        until(lambda: code_of(service(token).ListPolicies) == grpc.StatusCode.OK)
        self._versions += 1
        shutil.copytree(self.policies / "cartpole/1", self.policies / f"cartpole/{self._versions}")
        versions = range(1, self._versions + 1)
        until(lambda: [policy.version for policy in service("agent").ListPolicies().policies] == [*versions])
        assert page_of(addresses, "/healthz") == "SERVING\n"
        assert status_of(addresses, token="viewer")["serving"]


@contextlib.contextmanager
def reaping_server():
    """Starts a server whose sessions do not live long, and yields a check that one of them is reaped."""
    with running_server(flags=["--session_ttl=200ms"]) as server:
        service = server.agent

        def check():
            session = service.OpenSession(policy="cartpole").session_id
            gone = grpc.StatusCode.NOT_FOUND
            until(lambda: code_of(service.GetSession, session_id=session) == gone)  # which does not count as a use

        yield check


def main():
    print("clock: began", flush=True)
    folder = pathlib.Path(tempfile.mkdtemp())
    stepped = SteppedServer(folder)
    with (
        running_server(stepped.policies, stepped.flags) as addresses,
        grpc.insecure_channel(addresses.grpc) as channel,
        reaping_server() as check_reaper,
    ):
        agent = Service(channel, POLICY, grpc.intercept_channel(channel, Bearer("agent")))
        idle = agent.OpenSession(policy="cartpole").session_id
        agents = Agents(addresses.grpc)
        agents.wait_for_calls()
        for seconds in STEPS:
            step_clock(seconds)
            print(f"clock: {seconds / DAY:+g} days, now {datetime.datetime.now(datetime.UTC):%F %T}", flush=True)
            agents.wait_for_calls()
            check_reaper()
            stepped.check(addresses, channel, idle)
        agents.stop()


if __name__ == "__main__":
    main()
