"""Sessions move while requests are in flight: answers keep their order, and what only a server's memory had comes again."""

import contextlib
import threading

import grpc
import pytest
from beating import KINDS, Robot, answers_on_stream
from links import Link
from redis_servers import DURABLE, WITHOUT_REDIS, Redis, stopping
from security import code_of, until
from serving import DEADLINE_SECONDS, POLICY, method_of
from stored_sessions import Restartable, acting, expected_decision, opening, replicas_on, until_answered

SESSIONS = 60
STEPS = 6  # of an episode
EPISODES = 3


def pipelined(i, first=0):
    """Returns the requests of session i from decision `first` on, ends of episodes included, none of which needs an answer."""
    requests = []
    for episode in range(EPISODES):
        for step in range(STEPS):
            fields = acting(i, 0, episode * STEPS + step) | {"step": step}
            requests.append(fields | {"observation": [0.1 * step, 0.0, 0.0, 0.0][: 4 - i % 2]})
        decision = (episode + 1) * STEPS
        end = {"episode": episode, "steps": STEPS, "reward": 1.0, "terminated": True}
        requests.append({"session_id": f"{i:032x}", "step": STEPS, "decision": decision, "end_episode": end})
    return requests[first + first // STEPS :]


def is_end(request):
    return "end_episode" in request


def check_in_order(requests, answers):
    """Checks that each request has its answer, in its place."""
    assert [(answer.step, answer.error.message) for answer in answers] == [(sent["step"], "") for sent in requests]
    assert [answer.HasField("ended") for answer in answers] == [is_end(sent) for sent in requests]


def on_stream(server, requests):
    """Sends all requests without a wait, on a stream of its own. Returns the answers."""
    return answers_on_stream(server.channel, requests)


@WITHOUT_REDIS
@pytest.mark.parametrize("durability", ["ASYNC", "SYNC"])
def test_answers_keep_their_order_behind_a_claim(durability):
    with stopping([Redis(*DURABLE, password="")]) as [redis], replicas_on(redis) as (former, owner):
        for i in range(SESSIONS):
            former.OpenSession(**opening(i % 4) | {"session_id": f"{i:032x}", "durability": durability})
            begun = pipelined(i)[:3]
            check_in_order(begun, on_stream(former, begun))
            until(lambda begun=begun: former.Act(**begun[-1]).durable_decision == 3)
            rest = pipelined(i, 3)
            check_in_order(rest, on_stream(owner, rest))


@WITHOUT_REDIS
def test_a_refusal_does_not_overtake_an_answer_that_waits_for_the_store():
    with stopping([Redis(password="")]) as [redis], Link(f"127.0.0.1:{redis.port}") as link:
        with Restartable(f"redis://{link.address}", ["--max_tenant_bytes=16384"]) as server:
            server.OpenSession(**opening(0))
            link.hold_answers()
            request, stream = method_of(server.channel, POLICY, "ActStream")
            is_sent = threading.Event()

            def requests():
                yield request(**acting(0, 0, 0))
                yield request(**acting(0, 0, 1), traceparent="x" * 14000)  # more than the tenant may have in flight
                is_sent.set()

            answers = stream(requests(), timeout=DEADLINE_SECONDS)
            assert is_sent.wait(DEADLINE_SECONDS)
            link.heal()
            stored, refused = answers
            assert (stored.step, refused.step) == (0, 1)
            assert refused.error.code == grpc.StatusCode.RESOURCE_EXHAUSTED.value[0]


def test_pipelined_requests_behind_a_restart_find_their_sessions(tmp_path):
    """On one stream, several episodes of many sessions are under way."""
    with Restartable(f"file:{tmp_path}") as server:
        for i in range(SESSIONS):
            server.OpenSession(**opening(i) | {"version": 0})
            begun = pipelined(i)[:4]
            check_in_order(begun, on_stream(server, begun))
        server.restart()
        requests = [pipelined(i, 4) for i in range(SESSIONS)]
        sent = [request for group in zip(*requests, strict=True) for request in group]
        answers = on_stream(server, sent)
        for group in requests:
            of_session = [answer for answer in answers if answer.session_id == group[0]["session_id"]]
            check_in_order(group, of_session)


def test_a_request_that_is_ahead_says_what_is_expected(tmp_path):
    """Requests behind it that are in their place are answered."""
    with Restartable(f"file:{tmp_path}") as server:
        server.OpenSession(**opening(0))
        requests = pipelined(0)
        on_stream(server, requests[:3])
        server.restart()
        ahead = pipelined(0, STEPS + 1)[0]
        end = {"session_id": f"{0:032x}", "episode": 1, "steps": 1, "reward": 0.0}
        answers = on_stream(server, [ahead, *requests[3:]])
        error = answers[0].error
        assert error.code == grpc.StatusCode.FAILED_PRECONDITION.value[0]
        assert (error.expected_decision, error.expected_episode, error.expected_step) == (3, 0, 3)
        check_in_order(requests[3:], answers[1:])
        with pytest.raises(grpc.RpcError, match="episode: expected 3, received 1") as refused:
            server.EndEpisode(**end)
        assert expected_decision(server.channel, refused.value) == EPISODES * STEPS
        [result] = server.ActBatch(requests=[ahead]).results
        assert (result.expected_decision, result.expected_episode, result.expected_step) == (18, 3, 0)


class EpisodicRobot(Robot):
    """A robot whose requests have the last beat, over several episodes."""

    def __init__(self, service, **fields):
        super().__init__(service, **fields)
        self.first = self.episode = 0

    def request(self, history=1, **fields):
        step = len(self.beats)
        return super().request(min(step, history), **fields) | {"decision": self.first + step}

    def act(self, history=1, **fields):
        return super().act(history, **fields)

    def ending(self, begin):
        """Returns the request that ends the episode, with the beats from step `begin` on."""
        steps = len(self.beats)
        end = {"episode": self.episode, "steps": steps, "reward": 1.0, "terminated": True}
        place = {"session_id": self.id, "step": steps, "decision": self.first + steps}
        return place | {"history": self.beats[begin:], "end_episode": end}

    def next_episode(self):
        self.first, self.episode, self.beats = self.first + len(self.beats), self.episode + 1, []


def play(robot, disturb):
    """Plays three steps, `disturb`, the other steps of the episode, one of them without an answer, and two of the next.

    Returns the answers since `disturb`, and a function that returns the request of the end with beats from a step on.
    """
    for _ in range(3):
        robot.act(observed_at=1)
    disturb()
    answers = [robot.act(observed_at=1) for _ in range(4)]
    robot.execute(robot.opened.neutral_action)
    answers.append(robot.act(history=2))
    answers.append(robot.service.Act(**robot.ending(8)))
    endings = [robot.ending(begin) for begin in range(9)]
    robot.next_episode()
    answers += [robot.act(observed_at=1) for _ in range(2)]
    return answers, endings


@contextlib.contextmanager
def owner_behind_a_link():
    """Starts two servers on one Redis, the first of which reaches it by a Link."""
    with stopping([Redis(password="")]) as [redis], Link(f"127.0.0.1:{redis.port}") as link:
        near = Restartable(f"redis://127.0.0.1:{redis.port}")
        with Restartable(f"redis://{link.address}") as owner, near as other:
            yield link, owner, other


@WITHOUT_REDIS
@pytest.mark.parametrize("kind", KINDS)
def test_an_acknowledged_end_that_was_not_kept_comes_again(kind, tmp_path):
    """The owner cannot reach the store, and another server takes the session over: no server dies."""
    with Restartable(f"file:{tmp_path}") as server:
        undisturbed = EpisodicRobot(server, **KINDS[kind], durability="ASYNC")
        expected, _ = play(undisturbed, disturb=lambda: None)
        undisturbed.act(observed_at=1)
        value = undisturbed.value()
    with owner_behind_a_link() as (link, owner, other):
        robot = EpisodicRobot(owner, **KINDS[kind], durability="ASYNC")

        def cut():
            last = {"session_id": robot.id, "decision": 2} | robot.beat(2)
            until(lambda: owner.Act(**last).durable_decision == 3)
            link.cut()

        answers, endings = play(robot, cut)
        assert [str(answer.action) for answer in answers] == [str(answer.action) for answer in expected]
        assert {(answer.durable_decision, answer.durable_episode) for answer in answers} == {(3, 0)}
        ahead = robot.request(history=2, observed_at=1)
        [refused] = on_stream(other, [ahead])
        error = refused.error
        assert error.code == grpc.StatusCode.FAILED_PRECONDITION.value[0]
        assert (error.expected_decision, error.expected_episode, error.expected_step) == (3, 0, 3)
        # The store has the observation of the beat before, and not what was executed then.
        again = endings[error.expected_step - 1]
        ended, repeated, acted = on_stream(other, [again, again, ahead])
        assert str(ended.ended) == str(repeated.ended) == str(answers[5].ended)
        assert (ended.appended, repeated.appended, acted.appended) == (6, 0, 2)
        until(lambda: other.Act(**ahead).durable_decision == 12)
        assert other.Act(**ahead).durable_episode == 1
        assert other.ExportSession(session_id=robot.id).value == value
        # What the former owner has written late changes nothing.
        link.heal()
        assert str(until_answered(lambda: owner.Act(**ahead)).action) == str(acted.action)
        assert owner.ExportSession(session_id=robot.id).value == value


@WITHOUT_REDIS
def test_a_former_copy_opens_no_session_that_was_closed_elsewhere():
    with stopping([Redis(password="")]) as [redis], replicas_on(redis) as (former, owner):
        for i, durability in enumerate(["ASYNC", "SYNC"]):
            fields = opening(i) | {"durability": durability}
            former.OpenSession(**fields)
            until_answered(lambda i=i: owner.Act(**acting(i, 0, 0)))
            owner.CloseSession(session_id=fields["session_id"])
            until(lambda fields=fields: code_of(former.OpenSession, **fields) != grpc.StatusCode.UNAVAILABLE)
            assert code_of(former.OpenSession, **fields) == grpc.StatusCode.ALREADY_EXISTS
