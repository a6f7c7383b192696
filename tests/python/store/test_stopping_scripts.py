"""Scripts that Redis stops before any of their commands lose nothing: the journals of sessions and the logs of heads.

A Cluster does that to a script whose next key has moved to another node. Here a proxy stops them: each session has another
command before which its scripts end.
"""

import grpc
import pytest
from links import Link
from redis_servers import WITHOUT_REDIS, start_cluster, stopping
from security import code_of, until
from stored_sessions import Restartable, acting, comparable, opening, until_answered

pytestmark = WITHOUT_REDIS

KIND = 5  # of the sessions: they learn by themselves
MOST_COMMANDS = 12  # of a script
SESSIONS = range(MOST_COMMANDS)
# What only these scripts contain.
PUT, CLOSE, CLAIM, MOVE, REPLACE = b"math.max", b"'closed'", b"return records", b"'%d*$'", b"'since', now"
# Counts the commands of the script behind it.
STOP = """
local left, real = %d, redis
local function counted(call)
  return function(...)
    if left == 0 then error('Script attempted to access a non local key') end
    left = left - 1
    return call(...)
  end
end
local redis = {call = counted(real.call), pcall = counted(real.pcall), sha1hex = real.sha1hex}
"""


class StoppingRoute(Link):
    """A way to Redis, whose `target` is set later. Scripts that contain `stopped` end before command(keys)."""

    def __init__(self):
        super().__init__(None)
        self.stopped = None
        self.command = lambda keys: next(k for k in SESSIONS if name(k).encode() in keys)
        self.seen = set()  # keys of scripts that were stopped, or had fewer commands
        self.cuts = None  # session whose next entry is not forwarded, and ends its connection

    def pieces(self, pipe):
        if pipe.answers is None:
            yield from super().pieces(pipe)
            return
        lines = pipe.source.makefile("rb")
        while line := lines.readline():
            words = []
            for _ in range(int(line[1:])):
                words.append(lines.read(int(lines.readline()[1:]) + 2)[:-2])
            if self.cuts and words[0] == b"RPUSHX" and self.cuts.encode() in words[1]:
                self.cuts = None
                return
            if words[0] == b"EVAL" and self.stopped is not None and self.stopped in words[1]:
                keys = b" ".join(words[3 : 3 + int(words[2])])
                words[1] = (STOP % self.command(keys)).encode() + words[1]
                self.seen.add(keys)
            parts = [b"$%d\r\n%s\r\n" % (len(word), word) for word in words]
            yield b"*%d\r\n%s" % (len(words), b"".join(parts))


def name(k):
    return f"{KIND + 16 * k:032x}"


def request(k, step):
    return acting(KIND, 0, step) | {"session_id": name(k)}


def play(server, k, begin, end):
    answers = [until_answered(lambda step=step: server.Act(**request(k, step))) for step in range(begin, end)]
    for answer in answers:
        answer.ClearField("session_id")
    return [comparable(answer) for answer in answers]


@pytest.fixture(scope="module")
def undisturbed():
    with Restartable("memory") as server:
        server.OpenSession(**opening(KIND) | {"session_id": name(0), "durability": "NONE"})
        yield play(server, 0, 0, 30)


@pytest.fixture
def store():
    """Yields a node of a Cluster, a route to it that stops scripts, and a server that takes it, with the sessions."""
    with stopping([]) as nodes, StoppingRoute() as route:
        start_cluster(nodes, nodes=1, flags=("--cluster-announce-port", str(route.port)), password="")
        route.target = f"127.0.0.1:{nodes[0].port}"
        with Restartable(f"redis://127.0.0.1:{route.port}") as server:
            for k in SESSIONS:
                opened = opening(KIND) | {"session_id": name(k)}
                until(lambda opened=opened: code_of(server.OpenSession, **opened) == grpc.StatusCode.OK)
            yield nodes[0], route, server


def stop_all(route, script, call):
    """Stops a script of each session, and checks that some were stopped and others had fewer commands."""
    route.stopped = script
    codes = {call(k) for k in SESSIONS}
    assert codes == {grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.OK}
    assert all(is_seen(route, k) for k in SESSIONS)


def is_seen(route, k):
    return any(name(k).encode() in keys for keys in list(route.seen))


def next_owner(route, server):
    """Kills the owner. Another one, whose scripts end, takes over."""
    server.kill()
    route.stopped = None
    server.restart()


def check_all(server, answers, undisturbed):
    """Checks that the sessions have answered, and go on, as ones that nothing disturbed."""
    for k, before in answers.items():
        assert before + play(server, k, len(before), len(before) + 10) == undisturbed[: len(before) + 10], k


def act(server, step):
    return lambda k: code_of(server.Act, **request(k, step))


def test_a_snapshot(store, undisturbed):
    """The sixteenth decision writes one."""
    _, route, server = store
    answers = {k: play(server, k, 0, 15) for k in SESSIONS}
    stop_all(route, PUT, act(server, 15))
    next_owner(route, server)
    check_all(server, answers, undisturbed)


def test_a_snapshot_that_its_owner_writes_again(store, undisturbed):
    _, route, server = store
    answers = {k: play(server, k, 0, 15) for k in SESSIONS}
    stop_all(route, PUT, act(server, 15))
    route.stopped = None
    for k in SESSIONS:
        answers[k] += play(server, k, 15, 20)
    next_owner(route, server)
    check_all(server, answers, undisturbed)


def test_a_claim(store, undisturbed):
    _, route, server = store
    answers = {k: play(server, k, 0, 10) for k in SESSIONS}
    next_owner(route, server)
    stop_all(route, CLAIM, act(server, 10))
    next_owner(route, server)
    check_all(server, answers, undisturbed)


def test_a_move_to_another_epoch(store, undisturbed):
    """The connection ends while an entry is under way."""
    _, route, server = store
    answers = {k: play(server, k, 0, 10) for k in SESSIONS}

    route.stopped = MOVE
    for k in SESSIONS:
        route.cuts = name(k)
        until(lambda k=k: code_of(server.Act, **request(k, 10)) is not None and not route.cuts)
        until(lambda k=k: is_seen(route, k))
    next_owner(route, server)
    check_all(server, answers, undisturbed)


def test_an_end(store, undisturbed):
    """A session is open and whole, or the store knows that it has ended."""
    node, route, server = store
    answers = {k: play(server, k, 0, 10) for k in SESSIONS}
    stop_all(route, CLOSE, lambda k: code_of(server.CloseSession, session_id=name(k)))
    next_owner(route, server)
    states = {k: node.command(f"HGET ss:{{{name(k)}}}:o state") for k in SESSIONS}
    assert set(states.values()) == {b"open", b"closed"}
    check_all(server, {k: answers[k] for k in SESSIONS if states[k] == b"open"}, undisturbed)
    closed = [code_of(server.Act, **request(k, 10)) for k in SESSIONS if states[k] == b"closed"]
    assert set(closed) == {grpc.StatusCode.NOT_FOUND}


def test_a_log_that_is_written_again(store):
    """Also while that has stopped, the store has all of the head."""
    node, route, server = store
    learning = {"scope": "FLEET", "learning_rate": 0.3}
    session = server.OpenSession(policy="cartpole", version=1, seed=1, learning=learning).session_id
    for _ in range(3):
        server.Act(session_id=session, step=0, observation=[0.02, 0.1, -0.1, 0.05], reward=0.0)
        server.EndEpisode(session_id=session, reward=1.0, terminated=True)
    [log], [snapshot] = node.command("KEYS fl:{cartpole@1}*"), node.command("KEYS fs:{cartpole@1}*")
    log, snapshot = log.decode(), snapshot.decode()
    node.command(f"HSET {snapshot} wanted 1")
    until(lambda: node.command(f"HGET {snapshot} n") == b"3")
    for k in SESSIONS:
        route.command, route.seen, route.stopped = (lambda keys, k=k: k), set(), REPLACE
        node.command(f"DEL {log}")
        until(lambda: route.seen)
        assert node.command(f"HGET {snapshot} n") == b"3"
        route.stopped = None
        until(lambda: node.command(f"XLEN {log}") == 1)
    next_owner(route, server)
    head = server.admin.GetHead(policy="cartpole", version=1)
    assert head.updates + head.rejected_updates == 3
