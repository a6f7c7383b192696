"""A step that is sent again is answered again if it is the same one; a robot that shares a session id is told."""

import grpc
import pytest
import spikeserve
from beating import KINDS, Robot, answers_on_stream
from redis_servers import WITHOUT_REDIS
from security import until
from serving import POLICY, Service, series
from stored_sessions import Restartable

CONFLICTS = "spikeserve_conflicting_requests_total"
MISSING = "spikeserve_missing_rewards_total"


def count(server, name):
    """Returns a metric that has no series before its first event."""
    return sum(series(server, name))


def by_call(server, request):
    try:
        return 0, server.agent.Act(**request)
    except grpc.RpcError as error:
        return error.code().value[0], error.details()


def by_stream(server, request):
    [answer] = answers_on_stream(server.channel, [request])
    return (answer.error.code, answer.error.message) if answer.HasField("error") else (0, answer)


def by_batch(server, request):
    [result] = server.agent.ActBatch(requests=[request]).results
    return (result.code, result.message) if result.code else (0, result.response)


DOORS = [by_call, by_stream, by_batch]
REFUSED = grpc.StatusCode.FAILED_PRECONDITION.value[0]


def changed(request, path, value):
    """Returns a request with another value at a path of keys."""
    copy = list(request) if isinstance(request, list) else dict(request)
    copy[path[0]] = changed(copy[path[0]], path[1:], value) if len(path) > 1 else value
    return copy


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("history", [0, 3])
def test_a_step_with_another_content_is_no_repetition(server, door, kind, history):
    robot = Robot(server.agent, **KINDS[kind])
    for _ in range(5):
        robot.act(1 if robot.beats else 0)
    request = robot.request(history) if history else robot.request(executed_action=robot.beats[-1]["executed"])
    code, answer = door(server, request)
    assert code == 0
    value, before = robot.value(), count(server, CONFLICTS)
    changes = [
        (("observation", 2), 0.375, f"observation[2]: expected {request['observation'][2]:.9g}"[:28], "received 0.375"),
        (("observation",), [0.5], f"observation: expected {len(request['observation'])} numbers", "received 1"),
        (("reward",), 3.5, "reward: expected about 0.", "received 3.5"),
    ]
    place = ("history", 2, "executed") if history else ("executed_action",)
    executed, name = robot.beats[-1]["executed"], "executed_action"
    if "discrete" in executed:
        other = 1 - executed["discrete"]
        changes.append(((*place, "discrete"), other, f"{name}: expected index {1 - other}", f"received index {other}"))
    else:
        changes.append(((*place, "continuous", "values"), [-1.75], f"{name}[0]: expected ", "received -1.75"))
    for path, other, expected, received in changes:
        code, message = door(server, changed(request, path, other))
        assert code == REFUSED and expected in message and received in message, message
        assert "step 5" in message and "another robot may use this session_id" in message
    assert robot.value() == value
    assert count(server, CONFLICTS) == before + len(changes)
    code, again = door(server, request)
    assert code == 0
    for field in ("action", "stats"):
        assert getattr(again, field).SerializeToString() == getattr(answer, field).SerializeToString()
    robot.execute(answer.action)
    robot.act(1)


@pytest.mark.parametrize("door", DOORS)
def test_a_history_that_differs_from_the_session_is_refused(server, door):
    robot = Robot(server.agent, **KINDS["learning"])
    for _ in range(6):
        robot.act(1 if robot.beats else 0)
    value, before = robot.value(), count(server, CONFLICTS)
    changes = [
        (("history", 3, "observation", 1), 0.375, "history[3]: observation[1]: expected "),
        (("history", 2, "reward"), 4.5, "history[2]: reward: expected about 0."),
        (("history", 1, "executed", "discrete"), 1 - robot.beats[3]["executed"]["discrete"], "history[2]: executed_ac"),
    ]
    for path, other, message in changes:
        code, received = door(server, changed(robot.request(4), path, other))
        assert code == REFUSED and message in received, received
    assert robot.value() == value
    assert count(server, CONFLICTS) == before + 3
    robot.act(4)


def test_two_robots_with_one_session_id_are_told(server):
    with spikeserve.Client(server.grpc) as client:
        first = client.open_session("pendulum")
        second = spikeserve.Session(client, first.session_id)
        first.act([0.1, 0.2, 0.3])
        told = 0
        for step in range(1, 60):
            for robot, offset in ((first, 0.0), (second, 1.0)):
                try:
                    robot.act([0.01 * step + offset, 0.2, 0.3], 0.5)
                except spikeserve.FailedPreconditionError as error:
                    told += "another robot may use" in error.message or "expected" in error.message
        assert told >= 59


@WITHOUT_REDIS
def test_a_session_in_a_store_goes_on_only_with_what_was_executed(redis):
    """A kill that loses the last entry of the journal: the robot did something else than the server had answered."""
    with Restartable(f"redis://127.0.0.1:{redis.port}") as server:
        robot = Robot(server, durability="ASYNC", **KINDS["learning"])
        steady = Robot(server, durability="ASYNC", session_id="b" * 32, **KINDS["learning"])
        for step in range(12):
            for one in (robot, steady):
                one.act(1 if step else 0, executed={"discrete": step % 2})
        last = {"session_id": robot.id, "decision": 11, **robot.beat(11)}
        until(lambda: server.Act(**last).durable_decision == 12)
        server.kill()
        lose_last_entry(redis, robot.id)
        server.restart()
        code, message = by_call(server, robot.request(1))
        assert code == REFUSED and "history: expected beats from step 10 on, received those from step 11 on" in message
        assert server.Act(**robot.request(2)).appended == 1
        steady.act(1)
        exported = [server.GetSession(session_id=one.id) for one in (robot, steady)]
        assert exported[0].head_drift == exported[1].head_drift
        assert exported[0].return_to_go == exported[1].return_to_go
        server.kill()


def lose_last_entry(redis, session_id):
    keys = redis.command("KEYS", f"*{session_id}*")
    [journal] = [key for key in keys if redis.command("TYPE", key.decode()) == b"list"]
    assert redis.command("RPOP", journal.decode())


@pytest.mark.parametrize("door", DOORS)
def test_rewards_that_are_left_out_are_counted(server, door):
    before = count(server, MISSING)
    robot = Robot(server.agent, **KINDS["greedy"])

    def send(request):
        code, answer = door(server, {key: value for key, value in request.items() if key != "reward"})
        assert code == 0, answer
        return answer

    def missing():
        rewards = server.agent.GetSession(session_id=robot.id).missing_rewards
        assert count(server, MISSING) == before + rewards
        return rewards

    robot.execute(send(robot.request()).action)  # step 0 has none
    assert missing() == 0
    for _ in range(2):
        request = robot.request(1)
        answer = send(request)
        send(request)  # again
        robot.execute(answer.action)
        del robot.beats[-1]["reward"]
    assert missing() == 2
    for step in range(3, 6):
        robot.execute(robot.opened.neutral_action)
        if step != 4:
            del robot.beats[-1]["reward"]
        if step == 5:
            del robot.beats[-1]["observation"]
    robot.act(4)
    assert missing() == 4
    end = {"episode": 0, "steps": 7, "terminated": True}
    request = {"session_id": robot.id, "step": 7, "decision": 7, "history": robot.beats[-1:], "end_episode": end}
    assert [send(request).ended.steps for _ in range(2)] == [7, 7]
    assert missing() == 5
    rewards = 0.1 * 4 + 0.1 * 6  # of the steps that had one
    assert send(request).ended.episode_return == pytest.approx(rewards)


def test_a_repeated_step_gets_the_identical_answer_on_any_connection(server):
    service = server.agent
    session = service.OpenSession(policy="cartpole").session_id
    with grpc.insecure_channel(server.grpc) as channel:
        another = Service(channel, POLICY)
        for step in range(30):
            observation = [0.01 * step, -0.02 * step, 0.003 * step, 0.1]
            request = {"session_id": session, "step": step, "observation": observation, "reward": 1.0}
            assert service.Act(**request).SerializeToString() == another.Act(**request).SerializeToString()
    assert service.GetSession(session_id=session).decisions == 30
