"""Robots on real links: what happened without the server is in the session afterwards, exactly once."""

import json
import random

import grpc
import pytest
from beating import KINDS, Robot, answers_on_stream, as_fields, observation
from security import code_of, service_with, until
from serving import metric, page_of, running_server, status_of
from stored_sessions import Restartable

STEPS = 60
SECOND = 10**9  # nanoseconds
START = 10**15  # of the robot's clock


def undisturbed(service, steps=STEPS, **opening):
    """Plays a session that is asked for every step. Returns its value after each step, and its beats."""
    robot, values = Robot(service, **opening), []
    for _ in range(steps):
        robot.act()
        values.append(robot.value())
    return values, robot.beats


@pytest.mark.parametrize("kind", KINDS)
def test_a_cut_session_equals_the_undisturbed_one(service, kind):
    values, beats = undisturbed(service, **KINDS[kind])
    robot, rng = Robot(service, **KINDS[kind]), random.Random(5)
    acknowledged = 0
    while len(robot.beats) < STEPS - 10:
        for _ in range(rng.randrange(9)):
            robot.execute(beats[len(robot.beats)]["executed"])  # without the server
        known = len(robot.beats) - acknowledged
        # Some requests have beats that the server has acknowledged.
        history = min(len(robot.beats), known + rng.randrange(3))
        answer = robot.act(history, observed_at=START)
        acknowledged = answer.next_step
        assert acknowledged == len(robot.beats)
        assert as_fields(answer.action) == beats[len(robot.beats) - 1]["executed"]
        assert answer.appended == known
        assert robot.value() == values[len(robot.beats) - 1]


def test_held_actions_count_as_reported_ones(service):
    opening = KINDS["learning"]
    told = Robot(service, **opening)
    for step in range(20):
        told.act(1 if step else 0, executed={"discrete": step // 4 % 2})
    value = told.value()
    again = Robot(service, **opening)
    for step in range(19):
        again.execute({"discrete": step // 4 % 2})
    again.act(19)
    assert again.value() == value


def test_everything_counts_once(service):
    values, beats = undisturbed(service, **KINDS["greedy"])
    robot = Robot(service, **KINDS["greedy"])
    for step in range(7):
        robot.execute(beats[step]["executed"])
    first = robot.request(7)
    answers = [service.Act(**first) for _ in range(3)]
    assert [answer.appended for answer in answers] == [7, 0, 0]
    assert len({answer.action.SerializeToString() for answer in answers}) == 1
    # A request that was overtaken by the next one.
    robot.execute(answers[0].action)
    overtaken = robot.request(0, observed_at=START)
    robot.act(8)
    assert service.Act(**overtaken).next_step == 9
    assert code_of(service.Act, **first) == grpc.StatusCode.FAILED_PRECONDITION
    assert robot.value() == values[8]


def test_the_history_alone_is_appended(service):
    values, beats = undisturbed(service, **KINDS["learning"])
    robot = Robot(service, **KINDS["learning"])
    for step in range(STEPS):
        robot.execute(beats[step]["executed"])
    request = {
        "session_id": robot.id,
        "step": STEPS,
        "decision": STEPS,
        "history": robot.beats,
    }
    for appended in (STEPS, 0):
        answer = service.Act(**request)
        assert not answer.HasField("action") and not answer.HasField("stats") and not answer.expired
        assert (answer.appended, answer.next_step) == (appended, STEPS)
    assert robot.value() == values[-1]
    ended = service.EndEpisode(session_id=robot.id, reward=1.0, terminated=True, episode=0, steps=STEPS)
    assert ended.steps == STEPS
    assert ended.episode_return == pytest.approx(sum(0.1 * (t % 7) for t in range(1, STEPS)) + 1)


def without_observation(beat):
    return {key: value for key, value in beat.items() if key != "observation"}


def test_steps_without_an_observation_count_as_rewards(service):
    """In the middle of a history, before a decision, and before the end of the episode."""
    robot = Robot(service, **KINDS["learning"])
    robot.act()
    for step in range(1, 12):
        robot.execute({"discrete": step % 2})
        if step in (3, 4, 10, 11):
            robot.beats[-1] = without_observation(robot.beats[-1])
    # Nothing follows the last two.
    waiting = without_observation(robot.request(12))
    answer = service.Act(**waiting)
    assert (answer.appended, answer.dropped, answer.next_step) == (7, 2, 10)
    answer = robot.act(12)
    assert (answer.appended, answer.dropped, answer.next_step) == (0, 2, 13)
    assert answer.HasField("action")
    robot.execute({"discrete": 1})
    robot.beats[-1] = without_observation(robot.beats[-1])
    end = {"reward": 1.0, "terminated": True, "episode": 0, "steps": 14, "executed_action": {"discrete": 1}}
    last = without_observation(robot.request(3, end_episode=end))
    ended = [service.Act(**last).ended for _ in range(2)]
    assert ended[0] == ended[1]
    assert ended[0].steps == 14
    rewards = sum(0.1 * (step % 7) for step in range(1, 14)) + 1.0
    assert ended[0].episode_return == pytest.approx(rewards)


def test_a_late_request_takes_no_step_without_an_observation(service):
    robot = Robot(service, **KINDS["greedy"])
    neutral = robot.opened.neutral_action
    robot.act(observed_at=START, valid_until=START + 3600 * SECOND)
    robot.execute(neutral)
    robot.beats[-1] = without_observation(robot.beats[-1])
    late = robot.request(2, observed_at=START - 5 * SECOND, valid_until=START - 4 * SECOND)
    answer = service.Act(**late)
    assert answer.expired and (answer.next_step, answer.dropped) == (1, 0)
    answer = robot.act(2, observed_at=START, valid_until=START + 3600 * SECOND)
    assert (answer.next_step, answer.dropped) == (3, 1)


def test_an_expired_request_is_appended_and_not_decided(service):
    values, beats = undisturbed(service, **KINDS["greedy"])
    robot = Robot(service, **KINDS["greedy"])
    # The fastest request so far shows the way from the observation to the server.
    robot.act(observed_at=START, valid_until=START + 3600 * SECOND)
    robot.execute(beats[1]["executed"])
    # This one has waited for 5 s longer.
    late = robot.request(2, observed_at=START - 5 * SECOND, valid_until=START - 4 * SECOND)
    answer = service.Act(**late)
    assert answer.expired and not answer.HasField("action")
    assert (answer.appended, answer.next_step, answer.observed_at) == (1, 2, START - 5 * SECOND)
    # Sent again, it is still too late; nothing is appended twice.
    answer = service.Act(**late)
    assert answer.expired and answer.appended == 0
    robot.execute(beats[2]["executed"])
    answer = robot.act(2, observed_at=START, valid_until=START + 3600 * SECOND)
    assert not answer.expired and answer.appended == 1
    assert robot.value() == values[3]


def test_a_long_history_keeps_the_order(address, service):
    """600 beats, which are appended in parts, the requests behind them on one stream, and another session."""
    with grpc.insecure_channel(address) as channel:
        robot = Robot(service, policy="pendulum")
        neutral = robot.opened.neutral_action
        for _ in range(600):
            robot.execute(neutral)
        other = service.OpenSession(policy="cartpole").session_id
        requests = [robot.request(600)]
        for _ in range(3):
            robot.execute(neutral)
            requests.append(robot.request(2))
        robot.execute(neutral)
        # Without beats before its own.
        requests.append(robot.request(0, executed_action=as_fields(neutral)))
        requests.insert(1, {"session_id": other, "observation": observation(4, 0)})
        answers = answers_on_stream(channel, requests)
    ours = [answer for answer in answers if answer.session_id == robot.id]
    assert [answer.step for answer in ours] == [600, 601, 602, 603, 604]
    assert [answer.appended for answer in ours] == [600, 0, 0, 0, 0]
    assert not any(answer.HasField("error") for answer in answers)
    for _ in range(41):
        robot.execute(neutral)
    # In a batch, too, a long history is appended in parts, and what is behind it is decided once.
    behind = [{"session_id": other, "step": step, "observation": observation(4, step)} for step in (1, 2, 3)]
    batch = service.ActBatch(requests=[behind[0], robot.request(43), *behind[1:]])
    assert [result.code for result in batch.results] == [0, 0, 0, 0]
    assert batch.results[1].response.appended == 40  # the server has step 604
    assert service.GetSession(session_id=robot.id).step == 646
    assert service.GetSession(session_id=other).step == 4


def test_what_is_beyond_the_limit_counts_as_rewards(service):
    robot = Robot(service, policy="pendulum")
    limit = robot.opened.history_limit
    for _ in range(limit + 30):
        robot.execute(robot.opened.neutral_action)
    answer = robot.act(limit + 20, skipped_rewards=[0.1 * (step % 7) for step in range(10)])
    assert (answer.appended, answer.dropped) == (limit, 30)
    rewards = sum(0.1 * (step % 7) for step in range(1, limit + 31))
    state = service.GetSession(session_id=robot.id)
    assert state.step == limit + 31
    assert state.episode_return == pytest.approx(rewards)
    assert state.return_to_go == pytest.approx(state.target_return - rewards)


def with_wrong_step(request):
    request["history"][2] = request["history"][2] | {"step": 4}


def without_executed(request):
    request["history"][4] = {key: request["history"][4][key] for key in ("step", "observation", "reward")}


def with_endless_reward(request):
    request["history"][3] = request["history"][3] | {"reward": float("inf")}


def with_skipped(request):
    request.update(history=request["history"][2:], skipped_rewards=[0.1, float("nan")])


@pytest.mark.parametrize(
    "change, message",
    [
        (with_endless_reward, r"history\[3\]: reward: expected a finite number"),
        (with_skipped, r"skipped_rewards\[1\]: reward: expected a finite number"),
        (lambda request: request.update(history=[], skipped_rewards=[1.0]), "expected at least one beat behind skipped"),
        (with_wrong_step, r"history\[2\]: step: expected 3, received 4"),
        (without_executed, r"history\[4\]: executed_action: expected 1 continuous values, received none"),
        (lambda request: request.update(reward=float("nan")), "reward: expected a finite number"),
        (lambda request: request.update(observation=[1.0]), "observation: expected 3 numbers, received 1"),
        (lambda request: request.update(valid_until=5), "observed_at: expected a time"),
        (lambda request: request.update(observed_at=-5), "observed_at: expected at least 0, received -5"),
    ],
)
def test_a_request_that_is_wrong_appends_nothing(service, change, message):
    robot = Robot(service, policy="pendulum")
    robot.act()
    for _ in range(5):
        robot.execute(robot.opened.neutral_action)
    request = robot.request(5)
    change(request)
    robot.is_refused(request, message)


def test_beats_need_their_decision_and_no_gap(service):
    robot = Robot(service, policy="pendulum")
    for _ in range(5):
        robot.execute(robot.opened.neutral_action)
    missing = robot.request(5)
    del missing["decision"]
    assert code_of(service.Act, **missing) == grpc.StatusCode.INVALID_ARGUMENT
    assert code_of(service.Act, **robot.request(4)) == grpc.StatusCode.FAILED_PRECONDITION
    assert code_of(service.Act, **robot.request(5)) == grpc.StatusCode.OK


def test_old_requests_get_old_answers(service):
    robot = Robot(service, policy="cartpole")
    answer = service.Act(session_id=robot.id, observation=observation(4, 0))
    set_fields = {field.name for field, _ in answer.ListFields()}
    assert set_fields <= {"session_id", "step", "action", "action_probabilities", "return_to_go", "stats"}


@pytest.mark.parametrize("durability", ["ASYNC", "SYNC"])
def test_a_killed_server_has_lost_nothing(tmp_path, durability):
    opening = KINDS["learning"] | {"durability": durability}
    with Restartable(f"file:{tmp_path}/steady") as steady:
        values, beats = undisturbed(steady, steps=30, **opening)
        steady.kill()
    with Restartable(f"file:{tmp_path}/cut") as cut:
        robot = Robot(cut, **opening)
        robot.act()
        for end in (12, 29):
            while len(robot.beats) < end:
                robot.execute(beats[len(robot.beats)]["executed"])
            appending = robot.request(end)
            del appending["observation"]
            # An answer that is sent again shows how far the store is.
            until(lambda request=appending, last=end: cut.Act(**request).durable_decision == last)
            cut.restart()
            assert cut.Act(**appending).appended == 0
            robot.act(1)
            assert robot.value() == values[end]
        cut.kill()


def test_a_session_is_exported_within_its_tenant_and_recorded(tmp_path, tokens):
    log = tmp_path / "audit.jsonl"
    flags = [f"--tokens={tokens}", f"--audit_log={log}"]
    with running_server(flags=flags, log=tmp_path / "stderr") as addresses:
        with service_with(addresses, "agent") as agent:
            session = agent.OpenSession(policy="cartpole").session_id
            exported = agent.ExportSession(session_id=session)
            assert exported.policy == "cartpole" and len(exported.policy_sha256) == 64
            assert exported.value[:64].find(b"spikeserve.session.v1") >= 0
        for token, code in (("viewer", "PERMISSION_DENIED"), ("rival", "NOT_FOUND")):
            with service_with(addresses, token) as other:
                assert code_of(other.ExportSession, session_id=session).name == code
        assert log.read_text() == ""  # that of operators
        lines = [json.loads(line) for line in log.with_name("audit.jsonl.agents").read_text().splitlines()]
        ours = [line for line in lines if line["tenant"] == "fleet"]
        assert [(line["action"], line["request"]["session_id"]) for line in ours] == [("ExportSession", session)]
    logged = (tmp_path / "stderr").read_text()
    assert "agent action" in logged and "operator action" not in logged


def alerts(addresses):
    return {alert["name"] for alert in status_of(addresses)["alerts"] if alert["state"] == "firing"}


def test_the_server_sees_its_robots():
    with running_server() as addresses:
        service = addresses.agent
        robot = Robot(service, policy="pendulum", period_seconds=0.02, labels={"robot": "arm-7"})
        report = {"fresh": 10, "held": 5, "local": 3, "safe": 2, "late_answers": 4, "oldest_age_seconds": 0.3}
        report["invalid_observations"] = 1
        again = robot.request(0, report=report)
        answer = robot.act(report=report)
        assert answer.next_step == 1
        service.Act(**again)
        for source, beats in (("fresh", 10), ("held", 5), ("local", 3), ("safe", 2)):
            assert metric(addresses, "spikeserve_beats_total", policy="pendulum", source=source) == beats
        assert metric(addresses, "spikeserve_late_answers_total") == 4
        assert metric(addresses, "spikeserve_invalid_observations_total") == 1
        assert metric(addresses, "spikeserve_action_age_seconds_count") == 1
        assert metric(addresses, "spikeserve_repeated_requests_total") == 1
        for _ in range(3):
            robot.execute(robot.opened.neutral_action)
        decisions = metric(addresses, "spikeserve_decisions_total")
        robot.act(4)
        assert metric(addresses, "spikeserve_appended_beats_total", known="observation") == 3
        assert metric(addresses, "spikeserve_decisions_total") == decisions + 1
        assert metric(addresses, "spikeserve_robots") == 1

        def misses_beats():
            report["held"] += 1
            robot.act(1, report=report)
            return "SpikeserveRobotsWithoutActions" in alerts(addresses)

        until(misses_beats)
        until(lambda: metric(addresses, "spikeserve_silent_robots") == 1)
        until(lambda: "SpikeserveRobotsSilent" in alerts(addresses))
        listed = json.loads(page_of(addresses, "/sessions.json?filter=robot%3Darm-7"))
        [session] = listed["sessions"]
        assert session["silent"] and session["beats"]["held"] == str(report["held"])


COUNTS = ("fresh", "held", "local", "safe", "late_answers", "cancelled_calls", "reconnects", "invalid_observations")
TIMES = ("longest_gap_seconds", "oldest_age_seconds")
ABSURD = [
    *((name, 2**64 - 1, "at most 1000000000000") for name in COUNTS),
    *((name, value, "0 to 1e\\+07") for name in TIMES for value in (1e308, float("inf"), float("nan"), -1.0)),
]


@pytest.mark.parametrize(("name", "value", "expected"), ABSURD, ids=lambda value: str(value))
def test_a_report_that_no_robot_makes_is_refused(service, name, value, expected):
    robot = Robot(service, **KINDS["greedy"])
    robot.is_refused(robot.request(report={name: value}), f"report.{name}: expected {expected}, received ")


def test_what_a_robot_reports_fits_into_the_time():
    """A robot that lies counts for no more than one that plays at twice its rate."""
    with running_server() as addresses:
        service = addresses.agent
        liar = Robot(service, policy="pendulum", period_seconds=0.02)
        liar.act(report={"fresh": 10**12, "longest_gap_seconds": 1e7, "oldest_age_seconds": 1e7})
        for i in range(20):
            liar.act(report={"safe": i * 10**9, "fresh": 10**12 - i})
        honest = Robot(service, policy="pendulum", period_seconds=0.02, session_id="b" * 32)
        for i in range(1, 5):
            honest.act(report={"safe": 100 * i, "longest_gap_seconds": 0.5})

        def beats(source):
            return metric(addresses, "spikeserve_beats_total", policy="pendulum", source=source)

        assert beats("safe") == 400
        assert beats("fresh") == 0
        assert metric(addresses, "spikeserve_implausible_reports_total", policy="pendulum") == 20
        assert metric(addresses, "spikeserve_fresh_gap_seconds_sum") == 2.0
        assert metric(addresses, "spikeserve_action_age_seconds_count") == 0


def test_a_return_that_the_policy_cannot_have_is_no_part_of_its_mean():
    with running_server() as addresses:
        service = addresses.agent
        session = service.OpenSession(policy="cartpole").session_id
        for reward in (-3e38, 100.0, 3e38, 300.0, 1e6):
            service.Act(session_id=session, observation=[0.0] * 4)
            service.EndEpisode(session_id=session, reward=reward, terminated=True)
        assert metric(addresses, "spikeserve_episodes_total", policy="cartpole") == 5
        assert metric(addresses, "spikeserve_episode_return_mean", policy="cartpole") == 200
        assert metric(addresses, "spikeserve_episode_return_sum", policy="cartpole") == 400
        assert metric(addresses, "spikeserve_implausible_reports_total", policy="cartpole") == 3


@pytest.mark.parametrize("period", [0.0, -1.0, float("nan"), 0.0001, 3601.0])
def test_a_period_is_checked(service, period):
    for fields in ({"period_seconds": period}, {"labels": {"period_seconds": str(period)}}):
        with pytest.raises(grpc.RpcError, match="period_seconds: expected 0.001 to 3600, received"):
            service.OpenSession(policy="cartpole", **fields)
