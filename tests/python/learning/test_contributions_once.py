"""Each contribution is in the log of a shared head once, also if Redis forgets that it is there."""

import shutil

import pytest
from redis_servers import WITHOUT_REDIS, Files
from security import code_of, until
from serving import SHIPPED_POLICIES
from stored_sessions import replicas_on

pytestmark = WITHOUT_REDIS

LEARNERS = 8
STEPS = 3
FLEET = {"scope": "FLEET", "learning_rate": 0.3}


@pytest.fixture
def replicas(redis, tmp_path):
    policies = tmp_path / "policies"
    shutil.copytree(SHIPPED_POLICIES / "cartpole" / "1", policies / "cartpole" / "1")
    with replicas_on(redis, policies=policies) as started:
        yield started


def session(i):
    return f"{i:032x}"


def ok(call, **request):
    until(lambda: code_of(call, **request).value[0] == 0)


def learn(server, i):
    """Plays one episode, whose contribution is acknowledged."""
    opening = {"policy": "cartpole", "seed": i, "action_selection": "SAMPLE", "temperature": 4.0, "learning": FLEET}
    ok(server.OpenSession, session_id=session(i), **opening)
    act(server, i)
    ok(server.EndEpisode, **ending(i))


def act(server, i):
    for step in range(STEPS):
        request = {"step": step, "decision": step, "observation": [0.02 * step, 0.1, -0.1, 0.05], "reward": step % 2}
        ok(server.Act, session_id=session(i), **request)


def ending(i):
    return {"session_id": session(i), "reward": 1.0, "terminated": True, "episode": 0, "steps": STEPS}


def updates(server):
    head = server.admin.GetHead(policy="cartpole", version=1)
    return head.updates + head.rejected_updates


def entries_of(redis):
    [log] = redis.command("KEYS fl:*")
    return redis.command(f"XLEN {log.decode()}")


def forget_markers(redis):
    for key in redis.command("KEYS fc:*"):
        redis.command(f"DEL {key.decode()}")


def test_markers_that_redis_has_removed(redis, replicas):
    """The next owner of a session does not know whether its contribution was made, and asks the log."""
    first, second = replicas
    for i in range(LEARNERS):
        learn(first, i)
    assert entries_of(redis) == LEARNERS
    forget_markers(redis)
    first.kill()
    for i in range(LEARNERS):
        ok(second.EndEpisode, **ending(i))  # claims the session
    assert entries_of(redis) == LEARNERS


def test_what_this_server_has_not_read_yet_is_searched(redis, replicas):
    """The markers are gone, and the entries came from another server just now."""
    first, second = replicas
    learn(first, LEARNERS)
    until(lambda: updates(second) == updates(first))
    second.addresses.process.send_signal(19)
    for i in range(LEARNERS):
        learn(first, i)
    forget_markers(redis)
    first.kill()
    second.addresses.process.send_signal(18)
    for i in range(LEARNERS):
        ok(second.EndEpisode, **ending(i))
    assert entries_of(redis) == LEARNERS + 1


def test_a_log_that_was_set_back(redis, replicas):
    """Redis comes back with its files of some episodes ago, and the sessions are played again on another server."""
    first, second = replicas
    for i in range(LEARNERS):
        ok(first.OpenSession, session_id=session(i), policy="cartpole", seed=i, learning=FLEET)
        act(first, i)
    for i in range(4):
        ok(first.EndEpisode, **ending(i))
    files = Files(redis)
    for i in range(4, LEARNERS):
        ok(first.EndEpisode, **ending(i))
    until(lambda: updates(second) == updates(first))
    contributed = updates(first)
    first.kill()
    files.restore()
    for i in range(LEARNERS):
        ok(second.EndEpisode, **ending(i))
    until(lambda: updates(second) == contributed)
    markers = redis.command("KEYS fc:*")
    assert len(markers) == LEARNERS
