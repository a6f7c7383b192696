"""An episode ends behind the history of its beats, in the order of the stream, exactly once."""

import grpc
import pytest
from beating import KINDS, Robot, answers_on_stream
from security import code_of
from stored_sessions import Restartable


def end_of(robot, episode=0, **fields):
    """Returns the request that ends the robot's episode, with its last beat."""
    steps = len(robot.beats)
    end = {"episode": episode, "steps": steps, "reward": 1.0, "terminated": True} | fields
    return {
        "session_id": robot.id,
        "step": steps,
        "decision": steps,
        "history": robot.beats[-1:],
        "end_episode": end,
    }


@pytest.mark.parametrize("kind", KINDS)
def test_an_episode_ends_behind_its_history_as_by_a_call(service, kind):
    called = Robot(service, **KINDS[kind])
    for _ in range(20):
        called.act()
    end = end_of(called)["end_episode"]
    summary = service.EndEpisode(session_id=called.id, **end)
    value = called.value()
    robot = Robot(service, **KINDS[kind])
    for beat in called.beats:
        robot.execute(beat["executed"])
    answer = service.Act(**(end_of(robot) | {"history": robot.beats}))
    assert answer.ended == summary
    assert (answer.appended, answer.next_step) == (20, 0)
    assert not answer.HasField("action")
    assert robot.value() == value


def test_an_end_that_is_repeated_ends_no_later_episode(service):
    """Behind a history, its summary is returned although the next episode has begun."""
    robot = Robot(service, **KINDS["learning"])
    for _ in range(9):
        robot.act()
    end = end_of(robot)
    call = {"session_id": robot.id, **end["end_episode"]}
    ended = service.Act(**end).ended
    assert ended.steps == 9
    assert service.Act(**end).ended == service.EndEpisode(**call) == ended
    for step in range(3):
        service.Act(session_id=robot.id, decision=9 + step, **robot.beat(step))
    value = robot.value()
    answer = service.Act(**end)
    assert answer.ended == ended
    assert (answer.appended, answer.next_step) == (0, 3)
    assert code_of(service.EndEpisode, **call) == grpc.StatusCode.FAILED_PRECONDITION
    other = {"end_episode": end["end_episode"] | {"reward": 2.0}}
    assert code_of(service.Act, **(end | other)) == grpc.StatusCode.FAILED_PRECONDITION
    assert robot.value() == value
    assert service.EndEpisode(session_id=robot.id, reward=0.5, episode=1, steps=3).steps == 3
    assert code_of(service.Act, **end) == grpc.StatusCode.FAILED_PRECONDITION


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("first_form", ["call", "history"])
def test_an_end_is_known_again_in_its_other_form(service, kind, first_form):
    """The executed last action stands in a field of the call, and in the last beat of the history."""
    robot = Robot(service, **KINDS[kind])
    for _ in range(4):
        robot.act()
    robot.act(executed=robot.opened.neutral_action)
    behind = end_of(robot)
    executed = robot.beats[-1]["executed"]
    call = {"session_id": robot.id, "executed_action": executed} | behind["end_episode"]
    forms = {"call": lambda **more: service.EndEpisode(**call | more), "history": lambda: service.Act(**behind).ended}
    ended = forms[first_form]()
    value = robot.value()
    assert forms["call"]() == forms["history"]() == ended
    for other in ({"reward": 2.0}, {"executed_action": other_than(robot, executed)}):
        assert code_of(service.EndEpisode, **call | other) == grpc.StatusCode.FAILED_PRECONDITION
    assert robot.value() == value


def other_than(robot, executed):
    """Returns an action of the robot's that differs."""
    if "discrete" in executed:
        return {"discrete": 1 - executed["discrete"]}
    return {"continuous": {"values": [robot.opened.action_space.box.high[0]]}}


def test_the_next_episode_follows_its_end_on_a_stream(address, service):
    with grpc.insecure_channel(address) as channel:
        robot = Robot(service, policy="pendulum")
        for _ in range(100):  # appended in parts
            robot.execute(robot.opened.neutral_action)
        asked = [end_of(robot) | {"history": robot.beats}]
        asked += [{"session_id": robot.id, "decision": 100 + step, **robot.beat(step)} for step in range(3)]
        answers = answers_on_stream(channel, asked)
    assert answers[0].ended.steps == answers[0].appended == 100
    assert [(answer.step, answer.HasField("action")) for answer in answers[1:]] == [(0, True), (1, True), (2, True)]


@pytest.mark.parametrize(
    "change, message",
    [
        ({"end": {"observation": [0.0] * 3}}, "observation: expected none, because the request has end_episode"),
        ({"end": {"end_episode": {"steps": 5}}}, "end_episode: expected a request with decision and "),
        ({"steps": 4}, "end_episode.steps: expected 5 as step, received 4"),
        ({"observation": [1.0]}, "end_episode: observation: expected 3 numbers, received 1"),
        ({"target_return": float("nan")}, "end_episode: target_return: expected a finite number"),
        ({"reward": float("inf")}, "reward: expected a finite number"),
    ],
)
def test_an_end_that_is_wrong_appends_nothing(service, change, message):
    robot = Robot(service, policy="pendulum")
    robot.act()
    for _ in range(4):
        robot.execute(robot.opened.neutral_action)
    of_end = {} if "end" in change else change
    robot.is_refused(end_of(robot, **of_end) | {"history": robot.beats} | ({} if of_end else change["end"]), message)


def test_an_end_needs_all_beats(service):
    robot = Robot(service, policy="pendulum")
    robot.act()
    for _ in range(4):
        robot.execute(robot.opened.neutral_action)
    assert code_of(service.Act, **end_of(robot)) == grpc.StatusCode.FAILED_PRECONDITION
    assert service.GetSession(session_id=robot.id).step == 1
    assert service.Act(**(end_of(robot) | {"history": robot.beats})).ended.steps == 5


def test_a_restarted_server_knows_that_an_episode_has_ended(tmp_path):
    with Restartable(f"file:{tmp_path}") as server:
        robot = Robot(server, policy="pendulum", durability="SYNC")
        for _ in range(5):
            robot.act()
        end = end_of(robot)
        assert server.Act(**end).ended.episode_return > 0
        server.Act(session_id=robot.id, decision=5, **robot.beat(0))
        value = robot.value()
        server.restart()
        assert server.Act(**end).ended.steps == 5
        assert robot.value() == value
        server.kill()
