"""Clients without affinity, and without the optional numbers of a request: slower perhaps, never wrong."""

import contextlib

import grpc
import pytest
from redis_servers import WITHOUT_REDIS, Redis, stopping
from security import POLICY, until
from serving import method_of
from stored_sessions import Restartable, acting, comparable, opening, replicas_on

pytestmark = WITHOUT_REDIS

KINDS = [0, 4]  # a session that is frozen, and one that learns by itself
STEPS = 4  # of an episode
EPISODES = 3
LEVELS = ["ASYNC", "SYNC"]
DECISION = "decision"


@pytest.fixture(scope="module")
def redis():
    with stopping([Redis(password="")]) as [started]:
        yield started


@pytest.fixture(scope="module")
def both(redis):
    with replicas_on(redis) as started:
        yield started


@pytest.fixture
def replicas(redis, both):
    redis.command("FLUSHALL")
    return both


def request(session, i, episode, step, numbered):
    fields = acting(i, 0, episode * STEPS + step) | {"session_id": session, "step": step}
    if not numbered:
        del fields[DECISION]
    return fields


def end_of(session, episode, numbered):
    fields = {"session_id": session, "reward": 1.0 + episode, "terminated": True}
    return fields | ({"episode": episode, "steps": STEPS} if numbered else {})


def answered(call, fields, before=()):
    """Returns the answer, which must come in the end, as to a client that repeats its requests.

    `before`: calls with their fields, sent again to a server that has claimed a session before ASYNC has stored them.
    """

    def answers():
        try:
            return [call(**fields)]
        except grpc.RpcError as error:
            is_behind = before and error.code() == grpc.StatusCode.FAILED_PRECONDITION
            assert is_behind or error.code() == grpc.StatusCode.UNAVAILABLE, error
            for earlier, earlier_fields in before if is_behind else ():
                with contextlib.suppress(grpc.RpcError):  # most of them are there
                    earlier(**earlier_fields)
            return []

    return until(answers)[0]


def by_call(server):
    return lambda **fields: server.Act(**fields)


def by_batch(server):
    def act(**fields):
        [result] = server.ActBatch(requests=[fields]).results
        if result.code != 0:
            raise Refused(result.code)
        return result.response

    return act


def by_stream(server):
    request_class, call = method_of(server.channel, POLICY, "ActStream")

    def act(**fields):
        [answer] = call(iter([request_class(**fields)]))
        if answer.HasField("error"):
            raise Refused(answer.error.code)
        return answer

    return act


class Refused(grpc.RpcError):
    """The error of an item."""

    def __init__(self, number):
        self._code = next(code for code in grpc.StatusCode if code.value[0] == number)

    def code(self):
        return self._code


def without_id(answer):
    copy = type(answer)()
    copy.CopyFrom(answer)
    copy.session_id = ""
    return comparable(copy)


@pytest.fixture(scope="module")
def undisturbed():
    """Returns all answers of a session by kind, on a server without a store."""
    with Restartable("memory") as server:
        answers = {}
        for i in KINDS:
            session = server.OpenSession(**opening(i) | {"durability": "NONE"}).session_id
            answers[i] = []
            for episode in range(EPISODES):
                answers[i] += [
                    without_id(server.Act(**request(session, i, episode, step, True))) for step in range(STEPS)
                ]
                answers[i].append(server.EndEpisode(**end_of(session, episode, True)).SerializeToString())
    return answers


def opened(server, i, durability):
    fields = opening(i) | {"durability": durability}
    del fields["session_id"]
    return server.OpenSession(**fields).session_id


@pytest.mark.parametrize("numbered", [True, False])
@pytest.mark.parametrize("durability", LEVELS)
@pytest.mark.parametrize("i", KINDS)
@pytest.mark.parametrize("turn", [2, 3, 5])  # each server gets every n-th request
def test_requests_without_affinity(replicas, undisturbed, i, durability, numbered, turn):
    session = opened(replicas[0], i, durability)
    answers, sent = [], []

    def ask(method, fields):
        server = replicas[len(sent) // turn % 2]
        before = [(getattr(server, name), earlier) for name, earlier in sent]
        sent.append((method, fields))
        keeps = durability == "ASYNC" and numbered
        return answered(getattr(server, method), fields, before if keeps else ())

    for episode in range(EPISODES):
        for step in range(STEPS):
            answers.append(without_id(ask("Act", request(session, i, episode, step, numbered))))
        answers.append(ask("EndEpisode", end_of(session, episode, numbered)).SerializeToString())
    assert answers == undisturbed[i]


@pytest.mark.parametrize("send", [by_call, by_batch, by_stream])
@pytest.mark.parametrize("durability", LEVELS)
@pytest.mark.parametrize("i", KINDS)
def test_a_retry_at_a_former_owner(replicas, undisturbed, i, durability, send):
    """It has answered this step before, in another episode."""
    former, owner = replicas
    session = opened(former, i, durability)
    for step in range(STEPS):
        until(lambda step=step: stored(former, session, i, step, durability))
    owner_answers = [answered(owner.EndEpisode, end_of(session, 0, True)).SerializeToString()]
    for step in range(STEPS):
        owner_answers.append(without_id(answered(owner.Act, request(session, i, 1, step, False))))
    assert owner_answers == undisturbed[i][STEPS : 2 * STEPS + 1]
    again = answered(send(former), request(session, i, 1, STEPS - 1, False))
    assert without_id(again) == owner_answers[-1]


def stored(server, session, i, step, durability):
    answer = answered(server.Act, request(session, i, 0, step, True))
    return durability == "SYNC" or answer.durable_decision == step + 1


@pytest.mark.parametrize("durability", LEVELS)
def test_hedged_requests(replicas, undisturbed, durability):
    """Each request goes to both servers. Both answers are the right one, or an error."""
    for i in KINDS:
        session = opened(replicas[0], i, durability)
        right = iter(undisturbed[i])
        for episode in range(EPISODES):
            for step in range(STEPS):
                fields = request(session, i, episode, step, False)
                answers = [answered(server.Act, fields) for server in replicas]
                expected = next(right)
                assert [without_id(answer) for answer in answers] == [expected] * 2
            ends = [answered(server.EndEpisode, end_of(session, episode, False)) for server in replicas]
            expected = next(right)
            assert [end.SerializeToString() for end in ends] == [expected] * 2


@pytest.mark.parametrize("durability", LEVELS)
def test_nothing_is_claimed_that_only_this_server_has(redis, replicas, durability):
    """A client that asks the owner alone causes no claims, with and without numbers."""
    owner, _ = replicas
    for numbered in (True, False):
        session = opened(owner, 0, durability)
        epochs = set()
        for step in range(STEPS):
            fields = request(session, 0, 0, step, numbered)
            first = answered(owner.Act, fields)
            assert answered(owner.Act, fields).action == first.action
            epochs.add(redis.command(f"HGET ss:{{{session}}}:o epoch"))
        assert len(epochs - {None}) == 1
