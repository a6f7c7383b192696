"""Redis loses what it has acknowledged, or a part of a session, while the servers that own the sessions live."""

import signal
from concurrent.futures import ThreadPoolExecutor

import grpc
import pytest
from redis_servers import WITHOUT_REDIS, Files
from security import POLICY, code_of, fails_with, until
from serving import method_of, metric, run
from stored_sessions import (
    LEARNING,
    STEPS,
    Restartable,
    acting,
    decide,
    decision_instead_of,
    decisions,
    ending,
    expected_decision,
    opening,
    replicas_on,
    undisturbed_answers,
    until_answered,
)

pytestmark = WITHOUT_REDIS

KINDS = [0, 4]  # a session that is frozen, and one that learns by itself; both SYNC


@pytest.fixture
def replicas(redis):
    with replicas_on(redis) as started:
        yield started


@pytest.fixture(scope="module")
def undisturbed():
    return undisturbed_answers(KINDS)


def hash_of(i):
    return f"ss:{{{i:032x}}}:o"


def list_of(redis, i):
    return f"ss:{{{i:032x}}}:{redis.command(f'HGET {hash_of(i)} epoch').decode()}"


@pytest.mark.parametrize("i", KINDS)
def test_a_full_redis_refuses_whole_writes(redis, replicas, undisturbed, i):
    """The sixteenth decision writes a snapshot, for which there is no room."""
    first, second = replicas
    first.OpenSession(**opening(i))
    assert decisions(first, i, 0, 15) == undisturbed[i][:15]
    redis.command("CONFIG SET maxmemory 1")
    for _ in range(3):
        assert code_of(first.Act, **acting(i, 0, 15)) == grpc.StatusCode.UNAVAILABLE
    assert redis.command(f"LLEN {list_of(redis, i)}") == 16
    first.kill()
    redis.command("CONFIG SET maxmemory 0")
    assert decisions(second, i, 15, 20) == undisturbed[i][15:20]


@pytest.mark.parametrize("more", [3, 16, 20])  # decisions that Redis loses: also a snapshot, or lists of equal length
@pytest.mark.parametrize("i", KINDS)
def test_an_owner_writes_again_what_redis_has_lost(redis, replicas, undisturbed, i, more):
    first, second = replicas
    first.OpenSession(**opening(i))
    answers = decisions(first, i, 0, 4)
    files = Files(redis)
    answers += decisions(first, i, 4, 4 + more)
    files.restore()
    answers += decisions(first, i, 4 + more, 6 + more)
    first.kill()
    answers += decisions(second, i, 6 + more, 8 + more)
    assert answers == undisturbed[i][: 8 + more]


@pytest.mark.parametrize("i", KINDS)
def test_an_owner_without_requests_writes_again_what_redis_has_lost(redis, replicas, undisturbed, i):
    first, second = replicas
    first.OpenSession(**opening(i))
    decisions(first, i, 0, 4)
    files = Files(redis)
    decisions(first, i, 4, 8)
    files.restore()
    until(lambda: redis.command(f"LLEN {list_of(redis, i)}") == 1)  # one snapshot
    first.kill()
    assert decide(second, i, 8) == undisturbed[i][8]


@pytest.mark.parametrize("i", KINDS)
def test_the_next_owner_goes_on_from_what_redis_has(redis, replicas, undisturbed, i):
    """It expects an older decision, and gives the same answers. The former owner does not replace them."""
    first, second = replicas
    first.OpenSession(**opening(i))
    decisions(first, i, 0, 4)
    files = Files(redis)
    decisions(first, i, 4, 8)
    first.stop()
    files.restore()
    assert decision_instead_of(second, i, 8) == 4
    assert decisions(second, i, 4, 9) == undisturbed[i][4:9]
    first.resume()
    assert decide(first, i, 9) == undisturbed[i][9]
    assert decide(second, i, 10) == undisturbed[i][10]


@pytest.mark.parametrize("i", KINDS)
def test_a_journal_is_read_up_to_its_gap(redis, replicas, undisturbed, i):
    """A record stands behind a gap, as a server leaves it that found out too late."""
    first, second = replicas
    first.OpenSession(**opening(i))
    decisions(first, i, 0, 6)
    key = list_of(redis, i)
    first.kill()
    redis.command(f"LSET {key} 4 gone")
    redis.command(f"LREM {key} 1 gone")
    with pytest.raises(grpc.RpcError) as error:
        second.Act(**acting(i, 0, 6))
    assert expected_decision(second.channel, error.value) == 3
    assert decisions(second, i, 3, 9) == undisturbed[i][3:9]


@pytest.mark.parametrize("part", ["hash", "list", "both"])
@pytest.mark.parametrize("i", KINDS)
def test_the_loss_of_a_part_of_a_session_is_noticed(redis, replicas, undisturbed, i, part):
    """An acknowledged decision is never in a journal that nobody can find."""
    first, second = replicas
    first.OpenSession(**opening(i))
    decisions(first, i, 0, 5)
    keys = {"hash": hash_of(i), "list": list_of(redis, i)}
    redis.command("DEL " + " ".join(keys.values() if part == "both" else [keys[part]]))
    assert decide(first, i, 5) == undisturbed[i][5]
    first.kill()
    assert decisions(second, i, 6, 10) == undisturbed[i][6:10]


@pytest.mark.parametrize("policy", ["allkeys-random", "volatile-lru"])
@pytest.mark.parametrize("i", KINDS)
def test_a_redis_that_evicts_everything_refuses_and_loses_nothing(redis, replicas, undisturbed, i, policy):
    first, second = replicas
    first.OpenSession(**opening(i))
    answers = decisions(first, i, 0, 5)
    hash_, list_ = hash_of(i), list_of(redis, i)
    redis.command(f"CONFIG SET maxmemory-policy {policy}")
    redis.command("CONFIG SET maxmemory 1")
    until(lambda: redis.command(f"EXISTS {hash_} {list_}") == 0)
    for _ in range(3):
        assert code_of(first.Act, **acting(i, 0, 5)) == grpc.StatusCode.UNAVAILABLE
    redis.command("CONFIG SET maxmemory 0")
    answers += decisions(first, i, 5, 10)
    first.kill()
    answers += decisions(second, i, 10, 15)
    assert answers == undisturbed[i][:15]


def started_on(redis, log, *flags):
    return Restartable(f"redis://127.0.0.1:{redis.port}", flags, log=log)


def test_a_redis_that_evicts_is_no_store_for_sync(redis, tmp_path):
    redis.command("CONFIG SET maxmemory 100mb")
    redis.command("CONFIG SET maxmemory-policy volatile-lru")
    log = tmp_path / "log"
    with started_on(redis, log) as server:
        with fails_with(grpc.StatusCode.FAILED_PRECONDITION) as error:
            server.OpenSession(**opening(0))
        expected = "durability: maxmemory-policy of Redis: expected noeviction, received volatile-lru"
        assert expected in error.value.details()
        server.OpenSession(**opening(2) | {"durability": "ASYNC"})
        assert "expected noeviction, received volatile-lru" in log.read_text()
    with started_on(redis, log, "--store_may_evict") as server:
        server.OpenSession(**opening(0))


def test_a_session_that_redis_may_evict_now_is_refused(redis, replicas):
    first, _ = replicas
    first.OpenSession(**opening(0))
    first.Act(**acting(0, 0, 0))
    redis.command("CONFIG SET maxmemory 100mb")
    redis.command("CONFIG SET maxmemory-policy allkeys-lru")
    redis.command("CLIENT KILL TYPE normal")
    until(lambda: code_of(first.Act, **acting(0, 0, 1)) == grpc.StatusCode.UNAVAILABLE)
    redis.command("CONFIG SET maxmemory-policy noeviction")  # is noticed without a new connection
    until(lambda: code_of(first.Act, **acting(0, 0, 1)) == grpc.StatusCode.OK)


@pytest.mark.parametrize(
    ("setting", "value", "expected"),
    [
        ("appendonly", "no", "appendonly of Redis: expected yes, received no"),
        ("appendfsync", "everysec", "appendfsync of Redis: expected always, received everysec"),
    ],
)
def test_what_the_settings_of_redis_mean_is_said(redis, tmp_path, setting, value, expected):
    redis.command(f"CONFIG SET {setting} {value}")
    log = tmp_path / "log"
    with started_on(redis, log):
        until(lambda: expected in log.read_text())
    report = check(redis)
    assert (report.returncode, expected in report.stdout) == (0, True)


def check(redis):
    return run("spikectl", "store", "check", f"--session_store=redis://127.0.0.1:{redis.port}", status=None)


def test_orphans_fail_the_check(redis, replicas):
    first, _ = replicas
    first.OpenSession(**opening(0))
    first.Act(**acting(0, 0, 0))
    assert check(redis).returncode == 0
    first.kill()
    redis.command(f"DEL {hash_of(0)}")
    assert check(redis).returncode == 1


def test_a_session_stays_for_the_retention_after_its_last_use(redis):
    """Entries between snapshots count as use."""
    flags = ["--store_retention=8s", "--session_ttl=8s"]
    with Restartable(f"redis://127.0.0.1:{redis.port}", flags) as server:
        server.OpenSession(**opening(0))
        redis.command(f"PEXPIRE {hash_of(0)} 5000")
        redis.command(f"PEXPIRE {list_of(redis, 0)} 5000")
        server.Act(**acting(0, 0, 0))
        until(lambda: redis.command(f"PTTL {hash_of(0)}") > 6000)
        until(lambda: redis.command(f"PTTL {list_of(redis, 0)}") > 6000)


def test_a_closed_session_leaves_a_small_tombstone_for_a_while(redis, replicas):
    first, second = replicas
    first.OpenSession(**opening(0))
    for step in range(5):
        first.Act(**acting(0, 0, step))
    first.CloseSession(session_id=opening(0)["session_id"])
    assert redis.command(f"KEYS {hash_of(0)[:-1]}*") == [hash_of(0).encode()]
    assert redis.command(f"MEMORY USAGE {hash_of(0)}") < 300
    assert 0 < redis.command(f"PTTL {hash_of(0)}") <= 600_000
    assert code_of(second.OpenSession, **opening(0)) == grpc.StatusCode.ALREADY_EXISTS


def test_an_end_of_an_episode_that_redis_has_lost(redis, replicas):
    first, second = replicas
    first.OpenSession(**opening(0))
    decisions(first, 0, 0, STEPS)
    files = Files(redis)
    summary = first.EndEpisode(**ending(0, 0)).SerializeToString()
    files.restore()
    until(lambda: code_of(first.EndEpisode, **ending(0, 0)) == grpc.StatusCode.OK)
    assert first.EndEpisode(**ending(0, 0)).SerializeToString() == summary
    first.kill()
    until(lambda: code_of(second.EndEpisode, **ending(0, 0)) == grpc.StatusCode.OK)
    assert second.EndEpisode(**ending(0, 0)).SerializeToString() == summary


def take_over(replicas, i):
    """The session moves to the second replica, behind the back of the first one. Returns its answers."""
    first, second = replicas
    first.OpenSession(**opening(i))
    return decisions(first, i, 0, 4) + decisions(second, i, 4, 8)


def lose(redis, i):
    assert redis.command(f"DEL {hash_of(i)} {list_of(redis, i)}") == 2


@pytest.mark.parametrize("i", KINDS)
def test_the_last_copy_of_a_session_is_not_given_up(redis, replicas, undisturbed, i):
    """A request is ahead of a former owner, whose copy is the last one: it goes on with what it has."""
    first, second = replicas
    answers = take_over(replicas, i)
    second.kill()
    lose(redis, i)
    assert decision_instead_of(first, i, 8) == 4
    assert answers[:4] + decisions(first, i, 4, 10) == undisturbed[i][:10]


@pytest.mark.parametrize("i", KINDS)
def test_a_former_owner_leaves_a_lost_session_to_a_newer_copy(redis, replicas, undisturbed, i):
    first, second = replicas
    answers = take_over(replicas, i)
    lose(redis, i)
    assert code_of(first.Act, **acting(i, 0, 8)) == grpc.StatusCode.UNAVAILABLE  # and not NOT_FOUND
    answers += decisions(second, i, 8, 10)  # writes the session again
    answers += decisions(first, i, 10, 12)
    assert answers == undisturbed[i][:12]


@pytest.mark.parametrize("i", KINDS)
def test_a_newer_copy_that_comes_late_replaces_the_one_that_was_taken_back(redis, replicas, undisturbed, i):
    first, second = replicas
    answers = take_over(replicas, i)
    second.stop()
    lose(redis, i)
    until(lambda: code_of(first.Act, **acting(i, 0, 8)) == grpc.StatusCode.FAILED_PRECONDITION)
    assert redis.command(f"EXISTS {hash_of(i)}") == 1
    second.resume()
    answers += decisions(second, i, 8, 10)
    answers += decisions(first, i, 10, 12)
    assert answers == undisturbed[i][:12]


def test_a_session_that_has_ended_is_not_taken_back(redis, replicas):
    first, second = replicas
    take_over(replicas, 0)
    second.CloseSession(session_id=opening(0)["session_id"])
    assert code_of(first.Act, **acting(0, 0, 8)) == grpc.StatusCode.NOT_FOUND


@pytest.fixture
def three(redis):
    with replicas_on(redis, 3) as started:
        yield started


def remove(redis, i):
    """Redis removes the session, and its connections break, so that all servers look what is there; one writes its copy."""
    keys = redis.command(f"KEYS ss:{{{i:032x}}}:*")
    redis.command("DEL " + " ".join(key.decode() for key in keys))
    redis.command("CLIENT KILL TYPE normal")
    until(lambda: redis.command(f"EXISTS ss:{{{i:032x}}}:o") == 1)


@pytest.mark.parametrize("i", KINDS)
def test_the_newest_copy_replaces_an_older_one_of_any_owner(redis, three, undisturbed, i):
    """The first server writes what it had two owners ago. The third one has acknowledged more than that."""
    first, second, third = three
    first.OpenSession(**opening(i))
    answers = decisions(first, i, 0, 4) + decisions(second, i, 4, 8) + decisions(third, i, 8, 12)
    second.kill()
    third.stop()
    remove(redis, i)
    third.resume()
    answers += decisions(third, i, 12, 14) + decisions(first, i, 14, 16)
    assert answers == undisturbed[i][:16]


@pytest.mark.parametrize("i", KINDS)
def test_the_newest_copy_replaces_what_was_made_of_an_older_one(redis, three, undisturbed, i):
    """Another server has taken the older copy over meanwhile, and gone on with it: it has less nevertheless."""
    first, second, third = three
    first.OpenSession(**opening(i))
    answers = decisions(first, i, 0, 4) + decisions(third, i, 4, 12)
    third.stop()
    remove(redis, i)
    assert decisions(second, i, 4, 6) == undisturbed[i][4:6]  # sent again
    third.resume()
    answers += decisions(third, i, 12, 14) + decisions(second, i, 14, 16)
    assert answers == undisturbed[i][:16]


@pytest.mark.parametrize("i", KINDS)
def test_an_older_copy_replaces_nothing(redis, three, undisturbed, i):
    """The server that had claimed the session from the stored owner has less than that now."""
    first, second, _ = three
    first.OpenSession(**opening(i))
    answers = decisions(first, i, 0, 4) + decisions(second, i, 4, 5)
    second.stop()
    remove(redis, i)
    answers += decisions(first, i, 4, 8)[1:]
    second.resume()
    until(lambda: metric(second, "spikeserve_store_fences_total") + metric(second, "spikeserve_store_reseeds_total") > 0)
    answers += decisions(first, i, 8, 10) + decisions(second, i, 10, 12)
    assert answers == undisturbed[i][:12]


def test_the_end_of_an_episode_makes_a_copy_newer(redis, three):
    first, second, third = three
    first.OpenSession(**opening(0))
    decisions(first, 0, 0, STEPS - 1)
    decisions(second, 0, STEPS - 1, STEPS)
    until_answered(lambda: third.EndEpisode(**ending(0, 0)))
    second.kill()
    third.stop()
    remove(redis, 0)
    third.resume()
    until_answered(lambda: third.Act(**acting(0, 1, 0)))
    assert until_answered(lambda: third.GetSession(session_id=opening(0)["session_id"])).episode == 1


@pytest.mark.parametrize("change", ["verdict", "hand-over"])
def test_what_is_no_decision_makes_a_copy_newer(redis, three, change):
    """The first server writes what it had two owners ago: as many decisions and ends, but not what came since."""
    first, second, third = three
    session = {"session_id": opening(6)["session_id"]}
    verdict = session | {"episode": 0, "amendment_id": "judge"}
    first.OpenSession(**opening(6) | {"learning": LEARNING[3] | {"verdict_seconds": 3600.0}})
    decisions(first, 6, 0, STEPS)
    first.EndEpisode(**ending(6, 0))
    first.Act(**acting(6, 1, 0))
    lease = first.admin.TakeControl(**session, operator_id="ann", lease_seconds=60.0).lease_id
    for server in (second, third):
        until_answered(lambda at=server: at.Act(**acting(6, 1, 0)))
    if change == "verdict":
        until_answered(lambda: third.AmendEpisode(**verdict, reward=1.0))
    else:
        third.admin.ReturnControl(**session, lease_id=lease)
    second.kill()
    third.stop()
    remove(redis, 6)
    third.resume()
    answer = until_answered(lambda: third.Act(**acting(6, 1, 1)))
    if change == "verdict":
        assert code_of(third.AmendEpisode, **verdict, reward=2.0) == grpc.StatusCode.ALREADY_EXISTS
    else:
        assert answer.source.operator_id == ""


def test_a_copy_that_was_given_up_while_redis_lost_its_record_goes_on(redis):
    """The record of a decision is under way when the copy is given up, and Redis has nothing that it belongs to."""
    session = {"session_id": opening(0)["session_id"]}
    flags = ["--store_timeout=60s"]
    with Restartable(f"redis://127.0.0.1:{redis.port}", flags) as server, ThreadPoolExecutor() as threads:
        server.OpenSession(**opening(0))
        decisions(server, 0, 0, 4)
        redis.command("DEL " + " ".join(key.decode() for key in redis.command("KEYS ss:*")))
        redis.process.send_signal(signal.SIGSTOP)
        deciding = threads.submit(code_of, server.Act, **acting(0, 0, 4))
        until(lambda: server.GetSession(**session).decisions == 5)
        request, act = method_of(server.channel, POLICY, "Act")
        with pytest.raises(grpc.RpcError) as error:  # a request that is ahead of the copy, which is given up for it
            act(request(**acting(0, 0, 9)), timeout=1)
        assert error.value.code() == grpc.StatusCode.DEADLINE_EXCEEDED
        redis.process.send_signal(signal.SIGCONT)
        assert deciding.result() == grpc.StatusCode.UNAVAILABLE
        assert decide(server, 0, 5)


def test_a_copy_that_was_given_up_is_not_forgotten_for_an_older_one(redis, three):
    """A request is ahead of all that there is, so that the server gives its copy up, which is the newest one."""
    first, second, _ = three
    second.OpenSession(**opening(0))
    decisions(second, 0, 0, 4)
    decisions(first, 0, 4, 12)
    first.stop()
    remove(redis, 0)
    first.resume()
    assert decision_instead_of(first, 0, 20) == 12
