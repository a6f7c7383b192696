"""The stream of a session's decisions on the web port: what it sends, to whom, and how many may listen."""

import contextlib
import http.client
import json

import pytest

from security import OBSERVATION, TOKENS, service_with, until
from serving import DEADLINE_SECONDS, running_server
from test_status_json import validate

MOST_OF_CLIENT = 4


class Watcher:
    """A client of /watch."""

    def __init__(self, address, session, token=None):
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._connection = http.client.HTTPConnection(address, timeout=DEADLINE_SECONDS)
        self._connection.request("GET", f"/watch?session={session}", headers=headers)
        self.response = self._connection.getresponse()
        self.code = self.response.status

    def events(self):
        """Yields (name, document) of each event until the end of the stream."""
        name = None
        for line in self.response:
            key, _, value = line.decode().rstrip("\n").partition(": ")
            if key == "event":
                name = value
            elif key == "data":
                yield name, json.loads(value)

    def first(self, name, step=None):
        """Returns the first event with a name, and about a step if one is given."""
        return next(
            document
            for event, document in self.events()
            if event == name and step in (None, int(document["answer"]["step"]))
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.response.close()
        self._connection.close()


@pytest.fixture(scope="module")
def server():
    with running_server() as addresses:
        yield addresses.http, addresses.agent


@pytest.fixture(scope="module")
def guarded(addresses):
    """Opens a session of the tenant fleet. Yields a server with tokens and the session."""
    with service_with(addresses, "agent") as agent:
        yield addresses, playing(agent)


def playing(service):
    """Opens a session that has decided, and returns its id."""
    session = service.OpenSession(policy="cartpole").session_id
    service.Act(session_id=session, step=0, observation=OBSERVATION)
    return session


def test_each_decision_arrives_and_then_its_explanation(server):
    address, service = server
    session = playing(service)
    with Watcher(address, session) as watcher:
        assert watcher.code == 200
        assert watcher.response.headers["Content-Type"] == "text/event-stream"
        assert "default-src 'none'" in watcher.response.headers["Content-Security-Policy"]
        assert watcher.first("decision", step=0)["rasters"] == []
        answer = service.Act(session_id=session, step=1, observation=OBSERVATION)
        explained = watcher.first("explanation", step=1)
        assert sum(len(raster["ticks"]) for raster in explained["rasters"]) == answer.stats.spikes
        validate("explain", explained)


def test_a_reader_that_comes_later_sees_the_newest_decision_only(server):
    address, service = server
    session = playing(service)
    for step in range(1, 30):
        service.Act(session_id=session, step=step, observation=OBSERVATION)
    with Watcher(address, session) as watcher:
        assert int(watcher.first("decision")["answer"]["step"]) == 29


def test_the_stream_ends_with_the_session(server):
    address, service = server
    session = playing(service)
    with Watcher(address, session) as watcher:
        watcher.first("explanation")
        service.CloseSession(session_id=session)
        [(name, document)] = list(watcher.events())
        assert (name, document["code"]) == ("end", "NOT_FOUND")
        validate("error", document)


def test_watching_does_not_keep_a_session_alive(server):
    address, service = server
    session = playing(service)

    def idle():
        with contextlib.closing(http.client.HTTPConnection(address, timeout=DEADLINE_SECONDS)) as connection:
            connection.request("GET", f"/session.json?session={session}")
            return json.loads(connection.getresponse().read())["idle_seconds"]

    with Watcher(address, session) as watcher:
        watcher.first("explanation")
        before = idle()
        until(lambda: idle() > before + 0.2)


def test_watchers_are_bounded_and_leave_room_when_they_go(server):
    address, service = server
    session = playing(service)
    with contextlib.ExitStack() as stack:
        # Watchers of earlier tests may still be leaving.
        def enter():
            watcher = stack.enter_context(Watcher(address, session))
            return watcher.code == 200

        until(lambda: all([enter() for _ in range(MOST_OF_CLIENT)]) or stack.close())
        refused = Watcher(address, session)
        assert refused.code == 429
        error = json.loads(refused.response.read())
        assert error["message"] == "watchers of sessions: expected at most 16, and 4 of one address; try again later"
        validate("error", error)

    def welcome():
        with Watcher(address, session) as watcher:
            return watcher.code == 200

    until(welcome)


def test_unknown_sessions_and_parameters_are_refused(server):
    address, service = server
    for query, code in (("nobody", 404), ("", 404), ("nobody&since=3", 400)):
        with Watcher(address, query) as watcher:
            assert watcher.code == code


@pytest.mark.parametrize(
    ("token", "code"),
    [(None, 401), ("nonsense", 401), ("agent", 403), ("rival-viewer", 404), ("viewer", 200), ("watchman", 200)],
)
def test_a_watcher_needs_a_token_that_may_see_the_session(guarded, token, code):
    addresses, session = guarded
    with Watcher(addresses.http, session, token) as watcher:
        assert watcher.code == code


def test_a_token_that_is_taken_away_ends_the_stream(tmp_path):
    tokens = tmp_path / "tokens.json"
    tokens.write_text(json.dumps(TOKENS))
    with running_server(flags=[f"--tokens={tokens}"]) as addresses, service_with(addresses, "agent") as agent:
        session = playing(agent)
        with Watcher(addresses.http, session, "viewer") as watcher:
            watcher.first("decision")
            kept = [each for each in TOKENS["tokens"] if each["role"] != "viewer"]
            tokens.write_text(json.dumps(TOKENS | {"tokens": kept}))
            name, document = list(watcher.events())[-1]
            assert (name, document["code"]) == ("end", "UNAUTHENTICATED")
