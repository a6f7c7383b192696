"""A health check without a message ends; the latency of Act is known by policy."""

import grpc
import pytest
from security import HEALTH, OBSERVATION, fails_with
from serving import DEADLINE_SECONDS, page_of

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
