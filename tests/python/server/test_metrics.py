"""The metrics agree with the answers that the agents received."""

import math
import time

import grpc
import pytest
from agent_streams import AgentStream
from security import HEALTH, OBSERVATION, code_of, fails_with
from serving import (
    DEADLINE_SECONDS,
    RELEASED_POLICIES,
    SHIPPED_POLICIES,
    add_version,
    http_call,
    metric,
    page_of,
    run,
    running_server,
    series,
)

STEPS = 9
# The metric and a label of it, by the figure of an answer that it adds up.
COUNTERS = {
    "spikes": ("spikes_total", {}),
    "accumulates": ("synaptic_operations_total", {"kind": "accumulate"}),
    "multiply_accumulates": ("synaptic_operations_total", {"kind": "multiply_accumulate"}),
    "attention_products": ("synaptic_operations_total", {"kind": "attention"}),
    "membrane_updates": ("membrane_updates_total", {}),
    "coder_gains": ("other_operations_total", {"kind": "coder_gain"}),
    "layer_norm_elements": ("other_operations_total", {"kind": "layer_norm_element"}),
    "softmax_terms": ("other_operations_total", {"kind": "softmax_term"}),
    "gate_products": ("other_operations_total", {"kind": "gate_product"}),
}


@pytest.fixture
def policies(tmp_path):
    """Makes a folder with a policy in float32 and two versions of one in integers."""
    add_version(tmp_path, "floats", source=RELEASED_POLICIES / "cartpole-sparse/1")
    for version in (1, 2):
        add_version(tmp_path, "integers", version, source=SHIPPED_POLICIES / "cartpole/2")
    return tmp_path


@pytest.fixture
def counted(policies):
    """Starts a server of these policies that has counted nothing yet."""
    with running_server(policies) as started:
        yield started


def act(server, session, step=0):
    observation = [math.sin(0.7 * step + i) for i in range(4)]
    return server.agent.Act(session_id=session, step=step, observation=observation)


def test_counters_grow_by_exactly_what_the_answers_say(counted):
    answers = []
    for policy in ("floats", "integers"):
        session = counted.agent.OpenSession(policy=policy).session_id
        for step in range(STEPS):
            answers.append(act(counted, session, step).stats)
            act(counted, session, step)  # a retry
            assert code_of(act, counted, session, step + 5) == grpc.StatusCode.FAILED_PRECONDITION
        counted.agent.EndEpisode(session_id=session)
    assert metric(counted, "spikeserve_decisions_total") == len(answers) == 2 * STEPS
    for figure, (name, labels) in COUNTERS.items():
        expected = sum(getattr(stats, figure) for stats in answers)
        assert metric(counted, f"spikeserve_{name}", **labels) == expected > 0, figure
    hidden = sum(stats.spikes_by_stage.ffn_hidden for stats in answers)
    assert metric(counted, "spikeserve_spikes_total", stage="ffn_hidden") == hidden
    assert metric(counted, "spikeserve_spikes_per_decision_sum") == sum(stats.spikes for stats in answers)


def test_episodes_and_their_returns(counted):
    session = counted.agent.OpenSession(policy="integers").session_id
    for reward in (-30.0, 10.0):
        act(counted, session)
        counted.agent.EndEpisode(session_id=session, reward=reward)
    of = {"policy": "integers", "version": "2"}
    assert metric(counted, "spikeserve_episodes_total", **of) == 2
    assert metric(counted, "spikeserve_episode_return_bucket", le="-20", **of) == 1
    assert metric(counted, "spikeserve_episode_return_sum") == -20
    assert metric(counted, "spikeserve_episode_return_mean", **of) == -10


def test_learning_is_counted(counted):
    learning = {"modulator": "target", "learning_rate": 0.1, "max_drift": 0.001}
    session = counted.agent.OpenSession(policy="integers", learning=learning).session_id
    for step in range(STEPS):
        act(counted, session, step)
        act(counted, session, step)  # a retry
    learned = counted.agent.EndEpisode(session_id=session).learning
    assert (learned.updates, learned.rejected_updates) == (STEPS, 0)
    assert learned.head_drift == pytest.approx(0.001)
    assert metric(counted, "spikeserve_learning_updates_total") == STEPS
    assert metric(counted, "spikeserve_learning_rejected_total", reason="non_finite") == 0
    drift = metric(counted, "spikeserve_head_drift_ratio", policy="integers", scope="session", version="2")
    assert drift == pytest.approx(learned.head_drift)


def test_calls_are_timed_by_method_and_code(counted):
    session = counted.agent.OpenSession(policy="integers").session_id
    act(counted, session)
    code_of(act, counted, session, 9)
    code_of(act, counted, "nobody")
    stream = AgentStream(counted.channel)
    stream.act(session, 1)

    def calls(method, code):
        return metric(counted, "spikeserve_rpc_duration_seconds_count", method=method, code=code)

    assert calls("OpenSession", "OK") == calls("Act", "OK") == calls("ActStream", "OK") == 1
    assert calls("Act", "FAILED_PRECONDITION") == calls("Act", "NOT_FOUND") == 1
    assert metric(counted, "spikeserve_decision_duration_seconds_count") == 2
    assert 'le="5e-06"' in page_of(counted, "/metrics")
    stream.end()


def test_a_version_has_series_of_sessions_from_its_first_session_on(counted):
    info = {"policy": "floats", "version": "1", "environment": "CartPole-v1", "mode": "full"}
    assert metric(counted, "spikeserve_policy_info", **info) == metric(counted, "spikeserve_build_info") == 1
    assert series(counted, "spikeserve_non_finite_answers_total", policy="integers")
    assert not series(counted, "spikeserve_sessions") + series(counted, "spikeserve_decisions_total")
    counted.agent.OpenSession(policy="integers")
    assert series(counted, "spikeserve_sessions", policy="integers", version="2") == [1]
    assert series(counted, "spikeserve_decisions_total", policy="integers", version="2") == [0]
    assert not series(counted, "spikeserve_sessions", policy="floats")


def test_the_process_says_what_it_takes(policies):
    with running_server(policies, ["--max_sessions=7"]) as server:
        assert metric(server, "spikeserve_sessions_limit") == 7
        # The boot time in /proc does not follow every change of the clock.
        assert metric(server, "process_start_time_seconds") == pytest.approx(time.time(), abs=600)
        assert metric(server, "process_cpu_seconds_total") > 0
        assert metric(server, "process_resident_memory_bytes") > 1e6
        opened = metric(server, "process_open_fds")
        assert 3 < opened < metric(server, "process_max_fds")
        # Several, because sockets of the pages read so far may close in the meantime.
        others = [grpc.insecure_channel(server.grpc, [("grpc.use_local_subchannel_pool", 1)]) for _ in range(8)]
        for channel in others:
            grpc.channel_ready_future(channel).result()
        assert metric(server, "process_open_fds") > opened
        for channel in others:
            channel.close()


def test_promtool_is_content_and_the_first_page_leads_there(counted):
    session = counted.agent.OpenSession(policy="integers").session_id
    act(counted, session)
    counted.agent.EndEpisode(session_id=session, reward=-1.0)
    checked = run("promtool", "check", "metrics", input=page_of(counted, "/metrics"))
    assert checked.stdout + checked.stderr == ""
    first = page_of(counted, "/")
    assert 'href="metrics"' in first and 'href="healthz"' in first
    assert http_call(counted.http, "GET", "/etc/passwd")[0] == 404


CALLS = 'spikeserve_rpc_duration_seconds_count{code="%s",method="%s"%s} '


@pytest.mark.parametrize("method", ["Check", "Watch"])
def test_a_health_check_without_a_message_ends(server, method):
    call = server.channel.stream_stream(f"/{HEALTH}/{method}")(iter([]), timeout=DEADLINE_SECONDS)
    with fails_with(grpc.StatusCode.INTERNAL, whole="message: expected one request, received none"):
        list(call)


def test_act_is_timed_by_policy(server):
    def count(code, method, policy=None):
        label = "" if policy is None else f',policy="{policy}"'
        start = CALLS % (code, method, label)
        return sum(float(line.removeprefix(start)) for line in page_of(server, "/metrics").splitlines() if line.startswith(start))

    assert ',policy="' not in "\n".join(line for line in page_of(server, "/metrics").splitlines() if "rpc_duration" in line)
    for policy, acts in (("cartpole", 3), ("cartpole-small", 2)):
        session = server.agent.OpenSession(policy=policy).session_id
        for step in range(acts):
            server.agent.Act(session_id=session, step=step, observation=OBSERVATION)
        with pytest.raises(grpc.RpcError):
            server.agent.Act(session_id=session, step=99, observation=OBSERVATION)
    with pytest.raises(grpc.RpcError):
        server.agent.Act(session_id="missing", observation=OBSERVATION)
    assert [count("OK", "Act", policy) for policy in ("cartpole", "cartpole-small")] == [3, 2]
    assert count("FAILED_PRECONDITION", "Act", "cartpole") == 1
    assert count("NOT_FOUND", "Act") == 1
