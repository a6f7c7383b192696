"""What an agent's calls do: an episode adds up, explanations change nothing, answers wait for slow readers, idle sessions end."""

import json

import grpc
import pytest
from agent_streams import AgentStream
from made_policies import add_wide
from security import OBSERVATION, fails_with, until
from serving import metric, page_of, running_server, series


def test_an_episode_adds_up(server):
    session = server.agent.OpenSession(policy="cartpole").session_id
    acts = [server.agent.Act(session_id=session, step=step, observation=OBSERVATION, reward=0.1 * step) for step in range(3)]
    assert [answer.return_to_go for answer in acts] == pytest.approx([500.0, 499.9, 499.7])
    end = server.agent.EndEpisode(session_id=session, reward=4.0, terminated=True, target_return=3.0)
    assert end.episode_return == pytest.approx(0.1 + 0.2 + 4.0)
    assert end.steps == 3
    assert end.spikes == sum(answer.stats.spikes for answer in acts) > 0
    assert end.energy_joules == pytest.approx(sum(answer.stats.energy_joules for answer in acts))
    assert server.agent.Act(session_id=session, observation=OBSERVATION).return_to_go == 3.0
    state = server.agent.GetSession(session_id=session)
    assert (state.episode, state.step, state.episode_return, state.decisions) == (1, 1, 0.0, 4)
    assert state.spikes > end.spikes


def test_explanations_change_nothing(server):
    asked, left_alone = (server.agent.OpenSession(policy="cartpole").session_id for _ in range(2))
    before = metric(server, "spikeserve_decisions_total", policy="cartpole")
    for step in range(10):
        expected, actual = (
            server.agent.Act(session_id=session, step=step, observation=OBSERVATION) for session in (left_alone, asked)
        )
        assert (actual.action, actual.stats.spikes) == (expected.action, expected.stats.spikes)
        server.agent.Explain(session_id=asked)
    assert metric(server, "spikeserve_decisions_total", policy="cartpole") == before + 20


def test_without_a_decision_there_is_nothing_to_explain(server):
    with fails_with(grpc.StatusCode.NOT_FOUND, "nobody"):
        server.agent.Explain(session_id="nobody")
    session = server.agent.OpenSession(policy="cartpole").session_id
    with fails_with(grpc.StatusCode.FAILED_PRECONDITION, "session_id"):
        server.agent.Explain(session_id=session)
    server.agent.Act(session_id=session, observation=OBSERVATION)
    server.agent.Explain(session_id=session)
    server.agent.EndEpisode(session_id=session, reward=1.0)
    with fails_with(grpc.StatusCode.FAILED_PRECONDITION, "step 0"):
        server.agent.Explain(session_id=session)


def test_answers_that_were_read_make_room_for_others(tmp_path):
    """The answers of one round exceed what the server stores for one connection that does not read."""
    add_wide(tmp_path, actions=4000)
    with running_server(tmp_path) as server:
        played = [(server.agent.OpenSession(policy="wide").session_id, AgentStream(server.channel)) for _ in range(90)]
        for step in range(3):
            for session, stream in played:
                assert stream.act(session, step).step == step
        for _, stream in played:
            stream.end()


def test_an_idle_session_ends_although_it_is_watched():
    with running_server(flags=["--session_ttl=100ms"]) as server:
        session = server.agent.OpenSession(policy="cartpole").session_id

        def is_reaped():
            page_of(server, "/sessions.json")
            return sum(series(server, "spikeserve_sessions_reaped_total", reason="idle")) == 1

        until(is_reaped)
        with fails_with(grpc.StatusCode.NOT_FOUND, session):
            server.agent.Act(session_id=session, observation=OBSERVATION)
        assert metric(server, "spikeserve_sessions") == json.loads(page_of(server, "/sessions.json"))["open"] == 0
