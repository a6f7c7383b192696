"""Redis removes a session, and a server writes it again that had it once: the newest copy goes on."""

import signal
import urllib.request
from concurrent.futures import ThreadPoolExecutor

import grpc
import pytest
from redis_servers import DURABLE, WITHOUT_REDIS, Redis, stopping
from security import code_of, until
from serving import message_class
from stored_sessions import (
    STEPS,
    Restartable,
    acting,
    comparable,
    ending,
    expected_decision,
    opening,
    undisturbed_answers,
)

pytestmark = WITHOUT_REDIS

KINDS = [0, 4]  # a session that is frozen, and one that learns by itself; both SYNC


@pytest.fixture
def redis():
    with stopping([Redis(*DURABLE, password="")]) as [started]:
        yield started


@pytest.fixture
def replicas(redis):
    store = f"redis://127.0.0.1:{redis.port}"
    with Restartable(store) as first, Restartable(store) as second, Restartable(store) as third:
        yield first, second, third
        for server in (first, second, third):
            server.addresses.process.send_signal(signal.SIGCONT)
            server.close()


@pytest.fixture(scope="module")
def undisturbed():
    return undisturbed_answers(KINDS)


def answer_of(call, **fields):
    """Returns the answer, which may be refused at first, but for no other reason than that the session is elsewhere."""
    answers = []

    def answered():
        try:
            answers.append(comparable(call(**fields)) if "step" in fields else call(**fields))
        except grpc.RpcError as error:
            assert error.code() == grpc.StatusCode.UNAVAILABLE, error
        return answers != []

    until(answered)
    return answers[0]


def play(server, i, begin, end):
    return [answer_of(server.Act, **acting(i, 0, decision)) for decision in range(begin, end)]


def lose(redis, i):
    """Redis removes the session, and its connections break, so that all servers look what is there."""
    keys = redis.command(f"KEYS ss:{{{i:032x}}}:*")
    redis.command("DEL " + " ".join(key.decode() for key in keys))
    redis.command("CLIENT KILL TYPE normal")


def metric(server, name):
    with urllib.request.urlopen(f"http://{server.addresses.http}/metrics") as page:
        lines = page.read().decode().splitlines()
    return float(next(line for line in lines if line.startswith(name + " ")).split()[-1])


def pause(server):
    server.addresses.process.send_signal(signal.SIGSTOP)


def resume(server):
    server.addresses.process.send_signal(signal.SIGCONT)


def is_stored(redis, i):
    return redis.command(f"EXISTS ss:{{{i:032x}}}:o") == 1


@pytest.mark.parametrize("i", KINDS)
def test_the_newest_copy_replaces_an_older_one_of_any_owner(redis, replicas, undisturbed, i):
    """The first server writes what it had two owners ago. The third one has acknowledged more than that."""
    first, second, third = replicas
    first.OpenSession(**opening(i))
    answers = play(first, i, 0, 4) + play(second, i, 4, 8) + play(third, i, 8, 12)
    second.kill()
    pause(third)
    lose(redis, i)
    until(lambda: is_stored(redis, i))
    resume(third)
    answers += play(third, i, 12, 14) + play(first, i, 14, 16)
    assert answers == undisturbed[i][:16]


@pytest.mark.parametrize("i", KINDS)
def test_the_newest_copy_replaces_what_was_made_of_an_older_one(redis, replicas, undisturbed, i):
    """Another server has taken the older copy over meanwhile, and gone on with it: it has less nevertheless."""
    first, second, third = replicas
    first.OpenSession(**opening(i))
    answers = play(first, i, 0, 4) + play(third, i, 4, 12)
    pause(third)
    lose(redis, i)
    until(lambda: is_stored(redis, i))
    assert play(second, i, 4, 6) == undisturbed[i][4:6]  # sent again
    resume(third)
    answers += play(third, i, 12, 14) + play(second, i, 14, 16)
    assert answers == undisturbed[i][:16]


@pytest.mark.parametrize("i", KINDS)
def test_an_older_copy_replaces_nothing(redis, replicas, undisturbed, i):
    """The server that had claimed the session from the stored owner has less than that now."""
    first, second, _ = replicas
    first.OpenSession(**opening(i))
    answers = play(first, i, 0, 4) + play(second, i, 4, 5)
    pause(second)
    lose(redis, i)
    until(lambda: is_stored(redis, i))
    answers += play(first, i, 4, 8)[1:]
    resume(second)
    until(lambda: metric(second, "spikeserve_store_fences_total") + metric(second, "spikeserve_store_reseeds_total") > 0)
    answers += play(first, i, 8, 10) + play(second, i, 10, 12)
    assert answers == undisturbed[i][:12]


def test_the_end_of_an_episode_makes_a_copy_newer(redis, replicas):
    first, second, third = replicas
    first.OpenSession(**opening(0))
    play(first, 0, 0, STEPS - 1)
    play(second, 0, STEPS - 1, STEPS)
    answer_of(third.EndEpisode, **ending(0, 0))
    second.kill()
    pause(third)
    lose(redis, 0)
    until(lambda: is_stored(redis, 0))
    resume(third)
    answer_of(third.Act, **acting(0, 1, 0))
    assert answer_of(third.GetSession, session_id=opening(0)["session_id"]).episode == 1


def test_a_copy_that_was_given_up_while_redis_lost_its_record_goes_on(redis):
    """The record of a decision is under way when the copy is given up, and Redis has nothing that it belongs to."""
    session = {"session_id": opening(0)["session_id"]}
    flags = ["--store_timeout=60s"]
    with Restartable(f"redis://127.0.0.1:{redis.port}", flags) as server, ThreadPoolExecutor() as threads:
        server.OpenSession(**opening(0))
        play(server, 0, 0, 4)
        redis.command("DEL " + " ".join(key.decode() for key in redis.command("KEYS ss:*")))
        redis.process.send_signal(signal.SIGSTOP)
        deciding = threads.submit(code_of, server.Act, **acting(0, 0, 4))
        until(lambda: server.GetSession(**session).decisions == 5)
        request, response = (message_class(server.channel, f"spikeserve.v1.Act{name}") for name in ("Request", "Response"))
        act = server.channel.unary_unary(
            "/spikeserve.v1.PolicyService/Act", request.SerializeToString, response.FromString
        )
        with pytest.raises(grpc.RpcError) as error:  # a request that is ahead of the copy, which is given up for it
            act(request(**acting(0, 0, 9)), timeout=1)
        assert error.value.code() == grpc.StatusCode.DEADLINE_EXCEEDED
        redis.process.send_signal(signal.SIGCONT)
        assert deciding.result() == grpc.StatusCode.UNAVAILABLE
        assert answer_of(server.Act, **acting(0, 0, 5))
        server.close()


def test_a_copy_that_was_given_up_is_not_forgotten_for_an_older_one(redis, replicas):
    """A request is ahead of all that there is, so that the server gives its copy up, which is the newest one."""
    first, second, _ = replicas
    second.OpenSession(**opening(0))
    play(second, 0, 0, 4)
    play(first, 0, 4, 12)
    pause(first)
    lose(redis, 0)
    until(lambda: is_stored(redis, 0))
    resume(first)
    errors = []

    def is_told():
        with pytest.raises(grpc.RpcError) as error:
            first.Act(**acting(0, 0, 20))
        errors.append(error.value)
        return error.value.code() != grpc.StatusCode.UNAVAILABLE

    until(is_told)
    assert expected_decision(first.channel, errors[-1]) == 12
