"""Redis removes a session, and a server writes it again that had it once: the newest copy goes on."""

import signal
from concurrent.futures import ThreadPoolExecutor

import grpc
import pytest
from redis_servers import WITHOUT_REDIS
from security import POLICY, code_of, until
from serving import method_of, metric
from stored_sessions import (
    STEPS,
    Restartable,
    acting,
    decide,
    decision_instead_of,
    decisions,
    ending,
    opening,
    replicas_on,
    undisturbed_answers,
    until_answered,
)

pytestmark = WITHOUT_REDIS

KINDS = [0, 4]  # a session that is frozen, and one that learns by itself; both SYNC


@pytest.fixture
def replicas(redis):
    with replicas_on(redis, 3) as started:
        yield started


@pytest.fixture(scope="module")
def undisturbed():
    return undisturbed_answers(KINDS)


def lose(redis, i):
    """Redis removes the session, and its connections break, so that all servers look what is there."""
    keys = redis.command(f"KEYS ss:{{{i:032x}}}:*")
    redis.command("DEL " + " ".join(key.decode() for key in keys))
    redis.command("CLIENT KILL TYPE normal")


def is_stored(redis, i):
    return redis.command(f"EXISTS ss:{{{i:032x}}}:o") == 1


@pytest.mark.parametrize("i", KINDS)
def test_the_newest_copy_replaces_an_older_one_of_any_owner(redis, replicas, undisturbed, i):
    """The first server writes what it had two owners ago. The third one has acknowledged more than that."""
    first, second, third = replicas
    first.OpenSession(**opening(i))
    answers = decisions(first, i, 0, 4) + decisions(second, i, 4, 8) + decisions(third, i, 8, 12)
    second.kill()
    third.stop()
    lose(redis, i)
    until(lambda: is_stored(redis, i))
    third.resume()
    answers += decisions(third, i, 12, 14) + decisions(first, i, 14, 16)
    assert answers == undisturbed[i][:16]


@pytest.mark.parametrize("i", KINDS)
def test_the_newest_copy_replaces_what_was_made_of_an_older_one(redis, replicas, undisturbed, i):
    """Another server has taken the older copy over meanwhile, and gone on with it: it has less nevertheless."""
    first, second, third = replicas
    first.OpenSession(**opening(i))
    answers = decisions(first, i, 0, 4) + decisions(third, i, 4, 12)
    third.stop()
    lose(redis, i)
    until(lambda: is_stored(redis, i))
    assert decisions(second, i, 4, 6) == undisturbed[i][4:6]  # sent again
    third.resume()
    answers += decisions(third, i, 12, 14) + decisions(second, i, 14, 16)
    assert answers == undisturbed[i][:16]


@pytest.mark.parametrize("i", KINDS)
def test_an_older_copy_replaces_nothing(redis, replicas, undisturbed, i):
    """The server that had claimed the session from the stored owner has less than that now."""
    first, second, _ = replicas
    first.OpenSession(**opening(i))
    answers = decisions(first, i, 0, 4) + decisions(second, i, 4, 5)
    second.stop()
    lose(redis, i)
    until(lambda: is_stored(redis, i))
    answers += decisions(first, i, 4, 8)[1:]
    second.resume()
    until(lambda: metric(second, "spikeserve_store_fences_total") + metric(second, "spikeserve_store_reseeds_total") > 0)
    answers += decisions(first, i, 8, 10) + decisions(second, i, 10, 12)
    assert answers == undisturbed[i][:12]


def test_the_end_of_an_episode_makes_a_copy_newer(redis, replicas):
    first, second, third = replicas
    first.OpenSession(**opening(0))
    decisions(first, 0, 0, STEPS - 1)
    decisions(second, 0, STEPS - 1, STEPS)
    until_answered(lambda: third.EndEpisode(**ending(0, 0)))
    second.kill()
    third.stop()
    lose(redis, 0)
    until(lambda: is_stored(redis, 0))
    third.resume()
    until_answered(lambda: third.Act(**acting(0, 1, 0)))
    assert until_answered(lambda: third.GetSession(session_id=opening(0)["session_id"])).episode == 1


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


def test_a_copy_that_was_given_up_is_not_forgotten_for_an_older_one(redis, replicas):
    """A request is ahead of all that there is, so that the server gives its copy up, which is the newest one."""
    first, second, _ = replicas
    second.OpenSession(**opening(0))
    decisions(second, 0, 0, 4)
    decisions(first, 0, 4, 12)
    first.stop()
    lose(redis, 0)
    until(lambda: is_stored(redis, 0))
    first.resume()
    assert decision_instead_of(first, 0, 20) == 12
