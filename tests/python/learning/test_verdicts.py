"""Verdicts that come after the ends of episodes: what is learned, what is refused, and what recordings have then."""

import json
import shutil
import sys

import grpc
import numpy as np
import pytest
import spikeserve
from redis_servers import WITHOUT_REDIS
from security import fails_with, service_with, until
from serving import DEPLOY, SHIPPED_POLICIES, run, running_server
from spikeserve.conversion.recordings import read_file
from spikeserve.reward_model import follow
from stored_sessions import replicas_on, until_answered

OBSERVATIONS = np.random.default_rng(5).uniform(-0.2, 0.2, (8, 4))
STEPS = len(OBSERVATIONS)
HOUR = 3600.0
STORED = 2  # RecordingState
EXAMPLES = DEPLOY.parent / "examples"
SAMPLED = {"action_selection": "SAMPLE", "temperature": 4.0}


def session_id(policy, i=0):
    return f"{policy}{i}".encode().hex().rjust(32, "0")


def open_robot(server, policy, i=0, **learning):
    server.OpenSession(session_id=session_id(policy, i), policy=policy, seed=i, learning=learning, **SAMPLED)


def play(server, policy, i=0, episode=0):
    for step, observation in enumerate(OBSERVATIONS):
        place = {"step": step, "decision": episode * STEPS + step}
        until_answered(lambda p=place, o=observation: server.Act(session_id=session_id(policy, i), observation=o, **p))


def end(server, policy, i=0, episode=0, reward=0.0):
    ending = {"terminated": True, "episode": episode, "steps": STEPS, "reward": reward}
    return until_answered(lambda: server.EndEpisode(session_id=session_id(policy, i), **ending))


def verdict(policy, i=0, episode=0, **says):
    return {"session_id": session_id(policy, i), "episode": episode, "amendment_id": "test"} | says


def amend(server, *args, **says):
    return until_answered(lambda: server.AmendEpisode(**verdict(*args, **says)))


def bytes_of(message):
    """Makes messages of different servers comparable."""
    return message.SerializeToString(deterministic=True)


@pytest.fixture
def replicas(redis, tmp_path):
    """Two servers with one store and two policies of equal weights, of which one gets its rewards in time."""
    for policy in ("late", "timely"):
        shutil.copytree(SHIPPED_POLICIES / "cartpole/1", tmp_path / "policies" / policy / "1")
    with replicas_on(redis, policies=tmp_path / "policies") as started:
        yield started


@WITHOUT_REDIS
def test_a_private_head_learns_the_same_although_its_server_dies(replicas):
    """The server is killed between the end of an episode and its verdict, and after the verdict."""
    first, second = replicas
    open_robot(first, "late", verdict_seconds=HOUR)
    open_robot(first, "timely")
    for episode in range(4):
        here = [first, second][episode % 2]
        for policy in ("late", "timely"):
            play(here, policy, episode=episode)
        reward = 3.0 + episode
        timely = end(here, "timely", episode=episode, reward=reward)
        ended = end(here, "late", episode=episode)
        assert ended.awaits_verdict and not ended.HasField("learning") and not timely.awaits_verdict
        here.kill()
        there = [second, first][episode % 2]
        answer = amend(there, "late", episode=episode, reward=reward)
        assert bytes_of(answer.learning) == bytes_of(timely.learning) and answer.episode_return == reward
        here.start()
        there.kill()
        assert bytes_of(amend(here, "late", episode=episode, reward=reward)) == bytes_of(answer)  # a retry
        there.start()
        heads = [
            until_answered(lambda p=p, at=here: at.GetSession(session_id=session_id(p), include_head_delta=True))
            for p in ("late", "timely")
        ]
        assert heads[0].head_delta == heads[1].head_delta and any(heads[0].head_delta)


@WITHOUT_REDIS
def test_a_fleet_learns_the_same_although_its_server_dies(replicas):
    """All robots have ended their episodes when the verdicts come, in the order of the rewards of the other fleet."""
    first, second = replicas
    robots = range(4)  # too few for the server to hold sessions out
    for i in robots:
        open_robot(first, "late", i, scope="FLEET", verdict_seconds=HOUR)
        open_robot(first, "timely", i, scope="FLEET")
        for policy in ("late", "timely"):
            play(first, policy, i)
    for i in robots:
        end(first, "late", i)
        end(first, "timely", i, reward=1.0 + i)
    first.kill()
    for i in robots:
        answer = amend(second, "late", i, reward=1.0 + i)
        assert answer.learning.updates == 1
        assert amend(second, "late", i, reward=1.0 + i) == answer
    late, timely = (second.admin.GetHead(policy=policy, include_weights=True) for policy in ("late", "timely"))
    assert late.delta == timely.delta and any(late.delta) and late.updates == len(robots)


@WITHOUT_REDIS
def test_a_fleet_learns_although_its_robots_have_closed_their_sessions(replicas):
    """By their server, and by another one after it has died."""
    first, second = replicas
    for i in range(2):
        open_robot(first, "late", i, scope="FLEET", verdict_seconds=HOUR)
        play(first, "late", i)
        assert end(first, "late", i, reward=1.0).awaits_verdict
        first.CloseSession(session_id=session_id("late", i))
    assert not first.admin.ListSessions(policy="late").sessions
    answer = amend(first, "late", 0, reward=2.0)
    assert answer.episode_return == 3.0 and answer.learning.updates == 1
    assert amend(first, "late", 0, reward=2.0) == answer
    first.kill()
    assert amend(second, "late", 1, reward=2.0).learning.updates == 1
    assert second.admin.GetHead(policy="late").updates == 2


def test_closed_sessions_are_no_robots_and_end(tmp_path):
    """They count as open until then. A fleet learns from what waits when its time is over; a private head is gone."""
    flags = [f"--session_store=file:{tmp_path}/sessions", "--compact_after=1s", "--max_sessions=2", "--usage_interval=50ms"]
    with running_server(flags=flags) as server:
        agent, admin = server.agent, server.admin
        for i, (scope, seconds) in enumerate((("SESSION", HOUR), ("FLEET", HOUR), ("FLEET", 1.0))):
            open_robot(agent, "cartpole", i, scope=scope, verdict_seconds=seconds)
            play(agent, "cartpole", i)
            assert end(agent, "cartpole", i, reward=2.0).awaits_verdict
            if i == 2:
                with fails_with(grpc.StatusCode.RESOURCE_EXHAUSTED, "max_sessions"):
                    agent.OpenSession(policy="cartpole")
            agent.CloseSession(session_id=session_id("cartpole", i))
        admin.HoldSessions(id="all", selection={"all": True})
        assert not admin.ListHolds(page_size=10, stored=True).sessions
        with fails_with(grpc.StatusCode.NOT_FOUND, "session_id"):
            agent.AmendEpisode(**verdict("cartpole", 0, reward=1.0))
        until(lambda: admin.GetHead(policy="cartpole").updates == 1)
        until(lambda: admin.ListSessions().stored_sessions == 1)
        agent.OpenSession(policy="cartpole")
        assert agent.AmendEpisode(**verdict("cartpole", 1, reward=1.0)).learning.updates == 1
        until(lambda: admin.GetUsage().rows[0].usage.contributions == 2)


@pytest.fixture(scope="module")
def server(tmp_path_factory, tokens):
    recordings = tmp_path_factory.mktemp("recordings")
    with running_server(flags=[f"--tokens={tokens}", f"--record_dir={recordings}"]) as started:
        started.recordings = recordings
        yield started


def test_what_is_refused_changes_nothing(server):
    with service_with(server, "agent") as agent, service_with(server, "rival") as rival:
        open_robot(agent, "cartpole", verdict_seconds=HOUR)
        play(agent, "cartpole")
        end(agent, "cartpole")

        def refuse(code, text, call=agent.AmendEpisode, episode=0, **says):
            with fails_with(getattr(grpc.StatusCode, code), text):
                call(**verdict("cartpole", episode=episode, **says))

        refuse("NOT_FOUND", "session_id", rival.AmendEpisode, reward=1.0)
        refuse("NOT_FOUND", "episode: expected one that has ended, below 1, received 1", episode=1, reward=1.0)
        refuse("NOT_FOUND", "episode", episode=-1, reward=1.0)
        refuse("INVALID_ARGUMENT", "rewards: expected 8 numbers, one a step, received 7", rewards=[1.0] * 7)
        refuse("INVALID_ARGUMENT", "reward: expected a finite number", reward=float("nan"))
        refuse("INVALID_ARGUMENT", "rewards[3]: expected a finite number", rewards=[1.0] * 3 + [float("inf")] * 5)
        refuse("INVALID_ARGUMENT", "amendment_id: expected 1 to 64 bytes, received 0", amendment_id="", reward=1.0)
        refuse("INVALID_ARGUMENT", "rewards: expected these, reward, success or label, received none")
        state = agent.GetSession(session_id=session_id("cartpole"), include_head_delta=True)
        assert not any(state.head_delta)
        first = agent.AmendEpisode(**verdict("cartpole", rewards=[0.5] * 8))
        assert first.episode_return == 4.0 and first.learning.updates == 1
        refuse("ALREADY_EXISTS", "amendment_id: expected the same verdict as before", rewards=[0.25] * 8)
        assert agent.AmendEpisode(**verdict("cartpole", rewards=[0.5] * 8)) == first
        agent.CloseSession(session_id=session_id("cartpole"))
        refuse("NOT_FOUND", "session_id", rewards=[0.5] * 8)


def test_an_episode_whose_time_is_over_is_learned_from_as_it_is(server):
    with service_with(server, "agent") as agent:
        open_robot(agent, "cartpole", verdict_seconds=1e-9)
        play(agent, "cartpole")
        assert end(agent, "cartpole", reward=2.0).awaits_verdict
        read = lambda: agent.GetSession(session_id=session_id("cartpole"), include_head_delta=True)
        assert not any(read().head_delta)
        agent.Act(session_id=session_id("cartpole"), step=0, observation=OBSERVATIONS[0])
        learned = read().head_delta
        assert any(learned)
        with fails_with(grpc.StatusCode.FAILED_PRECONDITION, "learning.verdict_seconds"):
            agent.AmendEpisode(**verdict("cartpole", reward=1.0))
        assert read().head_delta == learned
        agent.CloseSession(session_id=session_id("cartpole"))


@pytest.mark.parametrize(
    "learning, field",
    [
        (
            {"modulator": "target", "verdict_seconds": 1.0},
            "learning.verdict_seconds: expected unset unless modulator is",
        ),
        (
            {"rule": "corrections", "verdict_seconds": 1.0},
            "learning.verdict_seconds: expected unset unless rule learns",
        ),
        ({"verdict_seconds": 3601.0}, "learning.verdict_seconds: expected a number from 0 to 3600, received 3601"),
    ],
)
def test_sessions_that_cannot_wait_are_refused(server, learning, field):
    with service_with(server, "agent") as agent, fails_with(grpc.StatusCode.INVALID_ARGUMENT, field):
        agent.OpenSession(policy="cartpole", learning=learning, **SAMPLED)


def record(agent, policy="cartpole"):
    opened = agent.OpenSession(session_id=session_id(policy), policy=policy, record=True)
    for step, observation in enumerate(OBSERVATIONS):
        agent.Act(session_id=session_id(policy), step=step, observation=observation, reward=1.0)
    agent.EndEpisode(session_id=session_id(policy), reward=1.0, terminated=True, observation=OBSERVATIONS[0])
    return opened.recording


def test_recordings_get_a_line_and_keep_what_was_received(server):
    """An open session, then a closed one by the name of its recording."""
    with service_with(server, "agent") as agent, service_with(server, "rival") as rival:
        name = record(agent)
        rewards = np.arange(STEPS) / 4
        answer = agent.AmendEpisode(**verdict("cartpole", rewards=rewards, success=False, label="shaky"))
        assert answer.episode_return == rewards.sum() and not answer.HasField("learning")
        file = server.recordings / name / "000000.cbor"
        received = file.read_bytes()
        agent.CloseSession(session_id=session_id("cartpole"))
        second = {"session_id": name, "episode": 0, "amendment_id": "again", "reward": 2.0, "author": "ada"}
        assert agent.AmendEpisode(**second).episode_return == STEPS + 2.0
        assert agent.AmendEpisode(**second).episode_return == STEPS + 2.0
        with fails_with(grpc.StatusCode.ALREADY_EXISTS, "amendment_id"):
            agent.AmendEpisode(**second | {"reward": 3.0})
        outside = {"session_id": f"../{server.recordings.name}/{name}"}
        for caller, wrong in ((agent, outside), (agent, {"episode": 7}), (rival, {})):
            with fails_with(grpc.StatusCode.NOT_FOUND, "session_id"):
                caller.AmendEpisode(**second | wrong)
    assert file.read_bytes() == received
    lines = [json.loads(line) for line in file.with_suffix(".amendments").read_text().splitlines()]
    assert [(line["amendment_id"], line["author"]) for line in lines] == [("test", ""), ("again", "ada")]
    (read,) = read_file(file).episodes
    np.testing.assert_array_equal(read.rewards, [1.0] * (STEPS - 1) + [3.0])
    assert read.served["received_rewards"] == [1.0] * STEPS
    assert read.served["success"] is False and read.served["verdict"] == "shaky"


def test_a_verdict_that_the_recording_lacks_is_an_error(server):
    """Although the session has learned it: the same request writes it, and teaches nothing twice."""
    with service_with(server, "agent") as agent:
        learning = {"verdict_seconds": HOUR}
        robot = {"session_id": session_id("cartpole")}
        name = agent.OpenSession(policy="cartpole", record=True, learning=learning, **robot, **SAMPLED).recording
        play(agent, "cartpole")
        end(agent, "cartpole")
        file = server.recordings / name / "000000.amendments"
        until(file.with_suffix(".cbor").exists)
        file.mkdir()
        with fails_with(grpc.StatusCode.UNAVAILABLE, "recording: expected the verdict, which the session has"):
            agent.AmendEpisode(**verdict("cartpole", reward=2.0))
        learned = agent.GetSession(include_head_delta=True, **robot).head_delta
        assert any(learned)
        file.rmdir()
        answer = agent.AmendEpisode(**verdict("cartpole", reward=2.0))
        assert (answer.recording, answer.episode_return, answer.learning.updates) == (STORED, 2.0, 1)
        assert agent.GetSession(include_head_delta=True, **robot).head_delta == learned
        assert len(file.read_text().splitlines()) == 1
        agent.CloseSession(**robot)


def test_a_reward_model_judges_what_was_recorded(tmp_path):
    """The program finds the session that waits, teaches it, and does not judge twice. The example's session is closed."""
    folder = tmp_path / "recordings"
    with running_server(flags=[f"--record_dir={folder}"]) as server, spikeserve.Client(server.grpc) as client:
        learning = spikeserve.Learning(verdict_seconds=HOUR)
        options = spikeserve.SessionOptions(sample=True, record=True, learning=learning)
        with client.open_session("cartpole", options) as session:
            for observation in OBSERVATIONS:
                session.act(observation, 0.0)
            assert session.end_episode(0.0, terminated=True).awaits_verdict
            command = [sys.executable, "-m", "spikeserve", "reward_model", str(folder), "--model=reward_model:judge"]
            judge = lambda: run(*command, "--once", f"--server={server.grpc}", cwd=EXAMPLES).stdout
            # The episode is on the disk soon after its end.
            until(lambda: list(folder.rglob("*.cbor")))
            assert "return" in judge() and session.state().head_drift > 0.0
            (line,) = (folder / session.opening.recording / "000000.amendments").read_text().splitlines()
            assert json.loads(line)["author"] == "reward_model:judge"
        played = run(sys.executable, EXAMPLES / "reward_model.py", server.grpc).stdout
        assert played.count("awaits its verdict: True") == 5
        until(lambda: len(list(folder.rglob("*.cbor"))) == 6)
        assert judge().count("return") == 5
        assert judge() == ""


def test_a_verdict_that_is_refused_does_not_keep_the_others_waiting(tmp_path, capfd):
    folder = tmp_path / "recordings"
    lengths = []

    def judge(episode):
        lengths.append(episode.steps)
        return {"rewards": [1.0] * (episode.steps - (episode.steps == 3))}  # one is wrong

    with running_server(flags=[f"--record_dir={folder}"]) as server, spikeserve.Client(server.grpc) as client:
        with client.open_session("cartpole", spikeserve.SessionOptions(record=True)) as session:
            for steps in (3, 5):
                for observation in OBSERVATIONS[:steps]:
                    session.act(observation, 0.0)
                session.end_episode(0.0, terminated=True)
            until(lambda: len(list(folder.rglob("*.cbor"))) == 2)
            seen = set()
            judge_all = lambda: [amended.episode_return for _, amended in follow(folder, judge, client, "ada", seen)]
            assert judge_all() == [5.0]
            assert judge_all() == [] and lengths == [3, 5], "it is said once, and not asked again"
            assert "rewards: expected 3 numbers, one a step, received 2" in capfd.readouterr().err


def test_a_damaged_recording_does_not_keep_the_others_waiting(tmp_path, capfd):
    (tmp_path / "000000.cbor").write_bytes(b"x")
    seen = set()
    assert list(follow(tmp_path, lambda episode: 1.0, None, "ada", seen)) == []
    assert "000000.cbor: expected a dataset of spikeserve in CBOR" in capfd.readouterr().err
    assert seen == {tmp_path / "000000.cbor"}
