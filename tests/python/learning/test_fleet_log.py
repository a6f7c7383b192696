"""Replicas learn shared heads through an ordered log in Redis: each contribution once, and equal heads everywhere."""

import contextlib
import hashlib
import itertools
import json
import pathlib
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor

import grpc
import pytest
import spikeserve
from redis_servers import DURABLE, WITHOUT_REDIS, Files, Redis, start_cluster, stopping
from replicated import running_fleet
from security import HEALTH, SERVING, code_of, until
from serving import SHIPPED_POLICIES, Service, metric
from stored_sessions import Restartable, until_answered

pytestmark = WITHOUT_REDIS

FLEET = {"scope": "FLEET", "learning_rate": 0.3}
SAMPLING = {"action_selection": "SAMPLE", "temperature": 4.0}
LEARNERS = 64
EPISODES = 8
STEPS = 5
EARLIER_LOG = pathlib.Path(__file__).parent / "head_log"


@pytest.fixture
def redis():
    with stopping([Redis(password="")]) as [started]:
        yield started


@pytest.fixture
def start(redis, tmp_path):
    """Returns a function that starts a replica on one Redis server."""
    yield from replicas_on(redis.port, tmp_path)


@pytest.fixture
def start_on_durable(tmp_path):
    """Returns a Redis server that keeps its files, and a function that starts a replica on it."""
    with stopping([Redis(*DURABLE, password="")]) as [started]:
        for start in replicas_on(started.port, tmp_path):
            yield started, start


@pytest.fixture
def start_on_cluster(tmp_path):
    """Returns a function that starts a replica on a Cluster of Redis."""
    with stopping([]) as servers:
        start_cluster(servers, password="")
        yield from replicas_on(servers[0].port, tmp_path)


def replicas_on(port, tmp_path):
    """Yields a function that starts a replica, which serves version 1 of one policy."""
    shutil.copytree(SHIPPED_POLICIES / "cartpole" / "1", tmp_path / "policies" / "cartpole" / "1")
    numbers = itertools.count()
    with contextlib.ExitStack() as started:

        def start_one():
            log = tmp_path / f"log{next(numbers)}"
            replica = Restartable(f"redis://127.0.0.1:{port}", policies=tmp_path / "policies", log=log)
            return started.enter_context(replica)

        yield start_one


def head_of(replica):
    return replica.admin.GetHead(policy="cartpole", version=1, include_weights=True)


def weights(replica):
    """Returns all of a shared head that replicas must agree on."""
    head = head_of(replica)
    return head.delta[:], head.updates, head.rejected_updates, head.rollbacks, head.watched_return


def open_learner(replica, seed=1, session_id=""):
    fields = SAMPLING | {"learning": FLEET, "seed": seed, "session_id": session_id}
    return replica.OpenSession(policy="cartpole", version=1, **fields).session_id


def act(replica, session, steps=STEPS, reward=1.0):
    for step in range(steps):
        observation = [0.02 * step, 0.1, -0.1, 0.05]
        replica.Act(session_id=session, step=step, observation=observation, reward=reward * (step % 3))


def play(replica, session, steps=STEPS, reward=1.0):
    act(replica, session, steps, reward)
    return replica.EndEpisode(session_id=session, reward=reward, terminated=True)


def open_and_play(replica, seed=1, steps=STEPS):
    session = open_learner(replica, seed)
    play(replica, session, steps)
    return session


def key_of(redis, kind):
    """Returns the name of the log (fl) or of its snapshot (fs)."""
    [key] = redis.command(f"KEYS {kind}:*")
    return key.decode()


def entries_of(redis):
    return redis.command(f"XLEN {key_of(redis, 'fl')}")


def test_contributions_arrive_once_while_replicas_are_killed():
    """64 learners play on three replicas that are killed in turn. Redis keeps which contributions it has."""
    options = spikeserve.ClientOptions(timeout=2.0, retry=spikeserve.RetryOptions(max_elapsed=120))
    learning = spikeserve.Learning(scope="FLEET", learning_rate=0.3)
    session_options = spikeserve.SessionOptions(sample=True, temperature=4.0, learning=learning, version=1)
    played = threading.Semaphore(0)

    def learn(client, i):
        with client.open_session("cartpole", session_options) as session:
            for episode in range(EPISODES):
                for step in range(STEPS):
                    session.act([0.01 * i, 0.1, -0.1, 0.02 * step], 1.0 if step else 0.0)
                session.end_episode(1.0, terminated=True)
                played.release()
            return session.session_id

    with (
        running_fleet() as fleet,
        spikeserve.Client(fleet.addresses, options) as client,
        ThreadPoolExecutor(LEARNERS) as pool,
    ):
        learners = [pool.submit(learn, client, i) for i in range(LEARNERS)]
        for learner in learners:
            # One that fails lets the test continue to its result.
            learner.add_done_callback(lambda _: played.release(LEARNERS * EPISODES))
        # Every replica is killed twice, each time when a part of the episodes was played.
        for i in range(6):
            for _ in range(LEARNERS * EPISODES // 8):
                played.acquire()
            fleet.replicas[i % 3].kill()
            fleet.replicas[i % 3].start()
        sessions = {learner.result() for learner in learners}
        heads = [weights(replica.server) for replica in fleet.replicas]
        markers = fleet.redis.command("KEYS fc:*")
        entries = entries_of(fleet.redis)
    expected = {f"fc:{{cartpole@1}}:{session}:{episode}" for session in sessions for episode in range(EPISODES)}
    assert {marker.decode() for marker in markers} == expected
    assert entries == len(expected) == LEARNERS * EPISODES
    delta, updates, rejected, rollbacks, _ = heads[0]
    assert rollbacks == 0 and updates > 0 and updates + rejected == LEARNERS * EPISODES
    assert any(delta)
    assert heads[1] == heads[0] and heads[2] == heads[0]


def test_what_one_replica_does_all_see(start):
    first, second = start(), start()
    ours, theirs = open_learner(first), open_learner(second)
    play(first, ours)
    assert any(weights(first)[0]) and weights(second) == weights(first)
    play(second, theirs)
    assert head_of(first).updates == 2 and weights(second) == weights(first)

    second.admin.PauseLearning(policy="cartpole")
    before = weights(first)
    until(lambda: head_of(first).paused)
    play(first, ours)
    assert weights(first) == weights(second) == before
    first.admin.ResumeLearning()
    until(lambda: not head_of(second).paused)
    play(second, theirs)
    assert head_of(first).updates == 3 and weights(second) == weights(first)

    promoted = second.admin.PromoteHead(policy="cartpole", version=1)
    until(lambda: code_of(first.OpenSession, policy="cartpole", version=promoted.version) == grpc.StatusCode.OK)
    drift = head_of(first).drift
    assert second.admin.RollbackHead(policy="cartpole", version=1).drift == drift > 0
    assert weights(first) == weights(second)
    head = head_of(first)
    assert (head.drift, head.updates, head.rollbacks) == (0, 0, 1)


def teach(replica, session_id, operator_id, actions):
    """Plays an episode in which an operator takes these actions beside the robot."""
    executed = {"executed_source": {"kind": "OPERATOR", "operator_id": operator_id}}
    for step, action in enumerate(actions):
        observation = [0.02 * step, 0.1, -0.1, 0.05]
        reported = {"executed_action": {"discrete": action}, **executed} if step else {}
        replica.Act(session_id=session_id, step=step, observation=observation, reward=1.0, **reported)
    return replica.EndEpisode(session_id=session_id, reward=1.0, terminated=True)


def test_an_operator_is_undone_on_all_replicas(start):
    """Also on one that was killed, and by one that was: the log says who has taught what."""
    first, second = start(), start()
    learning = {"scope": "FLEET", "rule": "corrections"}
    ours, theirs = (r.OpenSession(policy="cartpole", version=1, learning=learning).session_id for r in (first, second))
    head = {"policy": "cartpole", "version": 1}
    undo = {**head, "seconds": 600.0}
    teach(first, ours, "ann", [1, 0, 0, 1])
    by_ann = weights(second)
    teach(second, theirs, "eve", [0, 1, 1, 1, 0])
    teach(first, ours, "eve", [0, 0, 1, 0, 1])
    poisoned = weights(first)
    second.kill()
    second.start()
    assert weights(second) == weights(first) == poisoned != by_ann
    assert second.admin.UndoCorrections(operator_id="bob", **undo).updates == 0
    undone = second.admin.UndoCorrections(operator_id="eve", **undo)
    assert (undone.updates, undone.head_drift) == (2, head_of(first).drift)
    assert weights(first) == weights(second) == by_ann and any(by_ann[0])  # bit for bit
    first.kill()
    first.start()
    assert weights(first) == by_ann
    teach(second, theirs, "eve", [0, 1, 1, 1, 0])  # and the fleet learns on
    assert weights(first) == weights(second) != by_ann
    assert first.admin.UndoCorrections(operator_id="ann", **undo).updates == 1
    assert weights(first) == weights(second) == weights(start())


def test_the_nodes_of_a_cluster(start_on_cluster):
    first, second = start_on_cluster(), start_on_cluster()
    for replica in (first, second):
        open_and_play(replica)
    assert head_of(first).updates == 2
    assert weights(first) == weights(second) == weights(start_on_cluster())


def test_a_pause_refuses_what_is_under_way(start):
    """The episode ends at a replica that may not know of the pause yet."""
    first, second = start(), start()
    sessions = [open_learner(first, seed) for seed in range(8)]
    for session in sessions:
        act(first, session)
    second.admin.PauseLearning(policy="cartpole")
    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda each: first.EndEpisode(session_id=each, reward=1.0, terminated=True), sessions))
    assert [head_of(each).updates for each in (first, second)] == [0, 0]


def test_a_replica_that_joins_has_the_head_before_it_serves(start):
    first = start()
    session = open_learner(first)
    for _ in range(3):
        play(first, session)
    second = start()
    assert Service(second.channel, HEALTH).Check(service="").status == SERVING
    # Sessions decide with the heads that they find; GetHead would read the log first.
    learner = open_learner(second, seed=2)
    assert second.GetSession(session_id=learner).head_drift == head_of(first).drift > 0
    assert weights(second) == weights(first)


def test_a_replica_joins_from_a_snapshot(redis, start):
    """The log is trimmed behind the snapshot, which has also what the budgets have counted."""
    first = start()
    sessions = [open_learner(first, seed) for seed in range(10)]
    for _ in range(101):
        for session in sessions:
            play(first, session, steps=1)
    number = int(redis.command(f"HGET {key_of(redis, 'fs')} n"))
    assert 1000 <= number <= 1010
    assert entries_of(redis) == 1010 - number + 1
    second = start()
    assert weights(second) == weights(first)
    assert head_of(first).updates + head_of(first).rejected_updates == 1010
    for session in sessions:
        play(second, session)
    assert weights(second) == weights(first)


def test_a_log_of_an_earlier_program(tmp_path):
    """Commit bae5a768 left a snapshot and 13 entries, after roll-backs and with a pause, and this head."""
    shutil.copy(EARLIER_LOG / "dump.rdb", tmp_path)
    with stopping([Redis("--dir", str(tmp_path), "--dbfilename", "dump.rdb", password="")]) as [redis]:
        # The record of the shipped file was written again since, so its digest, which ends the keys, is another one.
        digest = hashlib.sha256((SHIPPED_POLICIES / "cartpole/1/policy.safetensors").read_bytes()).hexdigest()[:12]
        for key in (key_of(redis, "fl"), key_of(redis, "fs")):
            redis.command(f"RENAME {key} {key.rpartition(':')[0]}:{digest}")
        number = int(redis.command(f"HGET {key_of(redis, 'fs')} n"))
        for start in replicas_on(redis.port, tmp_path):
            first = start()
            head = json.loads((EARLIER_LOG / "head.json").read_text())
            assert any(head[0]) and list(weights(first)) == head
            open_and_play(first)
            assert metric(first, "spikeserve_head_log_position") == number + entries_of(redis) - 1
            assert contributions(first) == head[1] + head[2] + 1 and weights(start()) == weights(first)


def test_the_guard_decides_once(start):
    replicas = [start(), start()]
    sessions = [open_learner(replica) for replica in replicas]
    ends = []
    for episode in range(40):
        # Half the return in the second window.
        reward = 1.0 if episode < 20 else 0.5
        ends.append(play(replicas[episode % 2], sessions[episode % 2], reward=reward))
    assert [end.learning.rolled_back for end in ends] == [False] * 39 + [True]
    assert ends[-1].learning.head_drift == 0 and ends[-2].learning.head_drift > 0
    assert weights(replicas[0]) == weights(replicas[1])
    assert [head_of(each).rollbacks for each in replicas] == [1, 1]
    rollbacks = [metric(each, "spikeserve_learning_rollbacks_total", scope="fleet") for each in replicas]
    assert sorted(rollbacks) == [0, 1]


def test_a_lost_entry_is_noticed_and_the_head_reloaded(redis, start):
    first, second = start(), start()
    session = open_and_play(first)
    assert weights(second) == weights(first)
    second.stop()
    for _ in range(3):
        play(first, session)
    log = key_of(redis, "fl")
    lost = redis.command(f"XRANGE {log} - +")[2][0].decode()
    assert redis.command(f"XDEL {log} {lost}") == 1
    second.resume()
    until(lambda: metric(second, "spikeserve_head_log_reloads_total", outcome="reloaded") == 1)
    assert weights(second) == weights(first)
    assert "error the log of shared heads lacks entries" in second.log.read_text()
    assert "warning shared heads reloaded from their log" in second.log.read_text()
    assert metric(first, "spikeserve_head_log_reloads_total") == 0
    third = start()
    assert weights(third) == weights(first) and head_of(third).updates == 4


def test_a_gap_that_none_can_fill_is_cut(redis, start):
    first = start()
    session = open_learner(first)
    for _ in range(3):
        play(first, session)
    first.kill()
    log = key_of(redis, "fl")
    lost = redis.command(f"XRANGE {log} - +")[1][0].decode()
    redis.command(f"XDEL {log} {lost}")
    second = start()
    until(lambda: Service(second.channel, HEALTH).Check(service="").status == SERVING)
    assert "error the log of shared heads was cut" in second.log.read_text()
    assert head_of(second).updates == 1
    play(second, session)
    assert head_of(second).updates == 2 and weights(start()) == weights(second)


def test_redis_loses_everything(redis, start):
    """The replicas write the heads that they have."""
    first, second = start(), start()
    open_and_play(first)
    assert weights(second) == weights(first)
    before = weights(first)
    redis.command("FLUSHALL")
    rewritten = "spikeserve_head_log_reloads_total"
    until(lambda: sum(metric(each, rewritten, outcome="rewritten") for each in (first, second)) >= 1)
    assert weights(first) == weights(second) == before
    open_and_play(second, seed=3)
    assert head_of(first).updates == 2 and weights(first) == weights(second) == weights(start())


def contributions(replica):
    head = head_of(replica)
    return head.updates + head.rejected_updates


@pytest.mark.parametrize("more", [1, 300])  # contributions after the snapshot: also more than a snapshot remembers
def test_a_log_that_is_gone_behind_its_snapshot(redis, start, more):
    """Redis has evicted it. Both replicas have all of it, and go on."""
    first, second = start(), start()
    session = open_and_play(first, steps=1)
    snapshot = key_of(redis, "fs")
    redis.command(f"HSET {snapshot} wanted 1")
    until(lambda: redis.command(f"HGET {snapshot} n") == b"1")
    for _ in range(more):
        play(first, session, steps=1)
    until(lambda: contributions(second) == 1 + more)
    redis.command(f"DEL {key_of(redis, 'fl')}")
    open_and_play(second, seed=2, steps=1)
    play(first, session, steps=1)
    assert contributions(first) == contributions(second) == 3 + more
    second.admin.PauseLearning(policy="cartpole")
    until(lambda: head_of(first).paused)
    assert weights(first) == weights(second) == weights(start())


def test_a_log_that_is_gone_when_no_server_has_more_than_its_snapshot(redis, start):
    first = start()
    open_and_play(first)
    snapshot = key_of(redis, "fs")
    redis.command(f"HSET {snapshot} wanted 1")
    until(lambda: redis.command(f"HGET {snapshot} n") == b"1")
    first.kill()
    redis.command(f"DEL {key_of(redis, 'fl')}")
    second = start()
    open_and_play(second, seed=2)
    assert contributions(second) == 2 and weights(start()) == weights(second)


def at_the_first_entry(first, second):
    """Returns the session of the first replica, and what ends one of the second. Both have taken one entry."""
    session, other = open_learner(first), open_learner(second, seed=2)
    act(second, other, steps=1)
    play(first, session, steps=1)
    until(lambda: contributions(second) == 1)
    return session, {"session_id": other, "reward": 1.0, "terminated": True, "episode": 0, "steps": 1}


def go_on_alone(first, second, session):
    """The first replica appends more, and both stop."""
    second.stop()
    for _ in range(4):
        play(first, session, steps=1)
    first.stop()


def end_before_the_other_looks(redis, first, second, end, log):
    """The second replica is ready to append. The first one, which has more, comes back meanwhile."""
    second.resume()
    ok = grpc.StatusCode.OK
    with ThreadPoolExecutor() as pool:
        ended = pool.submit(until, lambda: code_of(second.EndEpisode, **end) == ok)
        since = f"HGET fs{log[2:]} since"
        until(lambda: ended.done() or (redis.command(since) or b"0") != b"0")
        first.resume()
        ended.result()
    assert contributions(first) == contributions(second) == 6
    assert weights(first) == weights(second)


def test_the_fullest_copy_is_written_when_the_log_is_gone(redis, start):
    first, second = start(), start()
    session, end = at_the_first_entry(first, second)
    go_on_alone(first, second, session)
    log = key_of(redis, "fl")
    redis.command(f"DEL {log}")
    end_before_the_other_looks(redis, first, second, end, log)


def test_a_redis_that_comes_back_with_older_files(start_on_durable):
    """The second replica is where the files are, so that it misses nothing."""
    redis, start = start_on_durable
    first, second = start(), start()
    session, end = at_the_first_entry(first, second)
    files = Files(redis)
    go_on_alone(first, second, session)
    log = key_of(redis, "fl")
    files.restore()
    end_before_the_other_looks(redis, first, second, end, log)


def test_redis_is_away(redis, start):
    """A head can be read then, and nothing that was answered is lost when Redis comes back empty."""
    first, second = start(), start()
    session = open_and_play(first)
    before = weights(first)
    act(first, session)
    redis.kill()
    end = {"session_id": session, "reward": 1.0, "terminated": True, "episode": 1, "steps": STEPS}
    assert code_of(first.EndEpisode, **end) == grpc.StatusCode.UNAVAILABLE
    assert weights(first) == before
    for action in (first.admin.RollbackHead, first.admin.PromoteHead):
        assert code_of(action, policy="cartpole", version=1) == grpc.StatusCode.UNAVAILABLE
    assert code_of(first.admin.PauseLearning, policy="cartpole") == grpc.StatusCode.UNAVAILABLE
    redis.start()
    until(lambda: code_of(first.EndEpisode, **end) == grpc.StatusCode.OK)
    assert head_of(first).updates == 2
    assert weights(first) == weights(second) == weights(start())


def test_a_contribution_that_was_not_appended_is_repaired_once(redis, start):
    """The owner has stored the end of an episode, cannot append the contribution, and is killed."""
    first, second = start(), start()
    session = open_and_play(first)
    log = key_of(redis, "fl")
    redis.command(f"RENAME {log} kept")
    redis.command(f"SET {log} blocked")
    act(first, session)
    end = {"session_id": session, "reward": 1.0, "terminated": True, "episode": 1, "steps": STEPS}
    assert code_of(first.EndEpisode, **end) == grpc.StatusCode.UNAVAILABLE
    # Neither is the episode played twice, nor does the next one end before it is in the log.
    assert code_of(first.EndEpisode, **end) == grpc.StatusCode.UNAVAILABLE
    first.kill()
    redis.command(f"DEL {log}")
    redis.command(f"RENAME kept {log}")

    answer = until_answered(lambda: second.EndEpisode(**end))
    assert answer.learning.updates == 1
    assert second.EndEpisode(**end) == answer
    assert entries_of(redis) == 2
    assert head_of(second).updates == 2
    play(second, session)
    third = start()
    assert head_of(third).updates == 3 and weights(third) == weights(second)


def test_the_summary_has_the_outcome_of_the_merge(redis, start):
    """Over its budget, a contribution is refused, as on one server."""
    first, second = start(), start()
    sessions = [open_learner(replica) for replica in [first, second] * 3]
    # Six contributors on two replicas: the head is protected, and one of them may give four episodes of a window.
    until(lambda: redis.command("KEYS fm:*") and redis.command(f"ZCARD {key_of(redis, 'fm')}") == 6)
    for replica, session in zip([first, second] * 3, sessions, strict=True):
        learning = [play(replica, session).learning for _ in range(6)]
        if learning[0].updates == 1:  # it is not held out
            break
    updates = [(each.updates, each.rejected_updates) for each in learning]
    assert updates == [(1, 0)] * 4 + [(0, 1)] * 2
    assert head_of(second).rejected_updates == head_of(first).rejected_updates >= 2
