"""Neither tenant learns from an id that it chooses which stored sessions the other has; each has its own."""

import contextlib
import json

import grpc
import pytest
from redis_servers import DURABLE, WITHOUT_REDIS, Redis, stopping
from security import ADMIN, OBSERVATION, code_of, service_with, until
from serving import page_of
from stored_sessions import Restartable, until_answered

FOREIGN, UNKNOWN = "a" * 32, "b" * 32
NOT_FOUND = grpc.StatusCode.NOT_FOUND


@pytest.fixture(params=["file", pytest.param("redis", marks=WITHOUT_REDIS)])
def servers(request, tokens, tmp_path):
    """Starts the server of one tenant and that of the other, which are one server if the store is a file."""
    flags = [f"--tokens={tokens}"]
    with contextlib.ExitStack() as stack:
        if request.param == "file":
            server = stack.enter_context(Restartable(f"file:{tmp_path}/store", flags))
            started = (server, server)
        else:
            [redis] = stack.enter_context(stopping([Redis(*DURABLE, password="")]))
            store = f"redis://127.0.0.1:{redis.port}"
            started = tuple(stack.enter_context(Restartable(store, flags)) for _ in range(2))
        yield started


def opening(session, durability):
    return {"session_id": session, "policy": "cartpole", "seed": 1, "durability": durability}


def told(answer, session):
    """Returns what an answer tells beside its id."""
    assert answer.session_id == session
    answer.session_id = ""
    return answer.SerializeToString(deterministic=True)


def act(service, session, step):
    acting = {"session_id": session, "step": step, "decision": step, "observation": OBSERVATION}
    return until_answered(lambda: service.Act(**acting)).step


@pytest.mark.parametrize("durability", ["ASYNC", "SYNC"])
def test_an_id_of_another_tenant_is_as_any_other(servers, durability):
    first, second = servers
    with service_with(first.addresses, "agent") as ours, service_with(second.addresses, "rival") as theirs:
        ours.OpenSession(**opening(FOREIGN, durability))
        assert [act(ours, FOREIGN, step) for step in range(2)] == [0, 1]
        for call in (theirs.GetSession, theirs.ExportSession, theirs.Explain, theirs.EndEpisode, theirs.CloseSession):
            assert code_of(call, session_id=FOREIGN) == NOT_FOUND
        answers = [told(theirs.OpenSession(**opening(name, durability)), name) for name in (FOREIGN, UNKNOWN)]
        assert answers[0] == answers[1]
        assert [act(theirs, FOREIGN, step) for step in range(3)] == [0, 1, 2]
        assert told(theirs.OpenSession(**opening(FOREIGN, durability)), FOREIGN) == answers[0]  # sent again
        until(lambda: theirs.Act(session_id=FOREIGN, step=2, decision=2, observation=OBSERVATION).durable_decision == 3)
        assert act(ours, FOREIGN, 2) == 2
        until(lambda: ours.Act(session_id=FOREIGN, step=2, decision=2, observation=OBSERVATION).durable_decision == 3)
    for server in dict.fromkeys(servers):
        server.close()
    for server in dict.fromkeys(servers):
        server.start()
    # Each goes on at the other's server.
    with service_with(second.addresses, "agent") as ours, service_with(first.addresses, "rival") as theirs:
        assert act(theirs, FOREIGN, 3) == 3
        assert act(ours, FOREIGN, 3) == 3
        assert told(theirs.OpenSession(**opening(FOREIGN, durability)), FOREIGN) == answers[0]
        with service_with(first.addresses, "rival-operator", ADMIN) as admin:
            assert FOREIGN in [listed.session_id for listed in admin.ListSessions().sessions]
        page = json.loads(page_of(first, "/sessions.json", "rival-viewer"))
        assert FOREIGN in [listed["session_id"] for listed in page["sessions"]]
        ours.CloseSession(session_id=FOREIGN)
        assert code_of(ours.GetSession, session_id=FOREIGN) == NOT_FOUND
        assert act(theirs, FOREIGN, 4) == 4
        theirs.CloseSession(session_id=FOREIGN)
        assert code_of(theirs.GetSession, session_id=FOREIGN) == NOT_FOUND


def test_an_id_that_another_tenant_has_closed_is_as_any_other(servers):
    first, second = servers
    with service_with(first.addresses, "agent") as ours, service_with(second.addresses, "rival") as theirs:
        ours.OpenSession(**opening(FOREIGN, "SYNC"))
        ours.CloseSession(session_id=FOREIGN)
        assert told(theirs.OpenSession(**opening(FOREIGN, "SYNC")), FOREIGN)
        assert act(theirs, FOREIGN, 0) == 0
        theirs.CloseSession(session_id=FOREIGN)
