"""Several servers share the sessions in one Redis server."""

import contextlib
import json
import queue
import shutil
import signal
import time

import grpc
import pytest
from redis_servers import WITHOUT_REDIS, Redis
from security import POLICY, TOKENS, code_of, fails_with, service_with, until
from serving import DEADLINE_SECONDS, SHIPPED_POLICIES, method_of, metric, refusal_at_start, running_server
from stored_sessions import (
    SESSIONS,
    Restartable,
    acting,
    comparable,
    opening,
    play,
    undisturbed_play,
)

LARGEST_LEAD = 256  # decisions of one ASYNC session that may wait for the store
AGENT = (("authorization", "Bearer agent"),)


pytestmark = WITHOUT_REDIS


@pytest.fixture(scope="module")
def redis():
    started = Redis()
    yield started
    started.stop()


@pytest.fixture
def replicas(redis, password):
    """Two servers with one store."""
    redis.command("FLUSHALL")
    store = f"redis://127.0.0.1:{redis.port}/1"
    with Restartable(store, [password]) as first, Restartable(store, [password]) as second:
        yield first, second
        redis.process.send_signal(signal.SIGCONT)


def act(server, i, step, session=None):
    request = acting(i, 0, step)
    return server.Act(**request | ({"session_id": session} if session else {}))


def test_the_other_replica_goes_on_after_a_kill(replicas):
    first, second = replicas
    serving = [first]

    def disturb(episode, step):
        if (episode, step) in {(0, 21), (1, 5)}:
            serving[0].kill()
            serving[0] = second if serving[0] is first else first
            if (episode, step) == (0, 21):
                first.restart()

    assert play(lambda: serving[0], disturb) == undisturbed_play()
    assert metric(serving[0], 'spikeserve_store_claims_total{outcome="claimed"}') >= SESSIONS


def test_replicas_take_turns(replicas):
    """Each decision goes to the other replica, which claims the session as it is."""

    def played(session, servers):
        servers[0].OpenSession(**opening(4) | {"session_id": session})
        answers = [act(servers[step % 2], 4, step, session) for step in range(20)]
        for answer in answers:
            answer.ClearField("session_id")
        return [comparable(answer) for answer in answers]

    first, second = replicas
    assert played("a" * 32, [first, second]) == played("b" * 32, [first, first])
    assert metric(first, 'spikeserve_store_claims_total{outcome="claimed"}') == 9
    assert metric(second, 'spikeserve_store_claims_total{outcome="claimed"}') == 10


def test_reading_a_session_leaves_it_to_its_owner(redis, replicas):
    owner, other = replicas
    owner.OpenSession(**opening(5))
    session = {"session_id": opening(5)["session_id"], "include_head_delta": True}
    epoch = redis.command(f"HGET ss:{{{session['session_id']}}}:o epoch", database=1)
    for step in range(20):
        act(owner, 5, step)
        views = [server.GetSession(**session).SerializeToString(deterministic=True) for server in (other, owner)]
        assert views[0] == views[1]
    assert redis.command(f"HGET ss:{{{session['session_id']}}}:o epoch", database=1) == epoch
    claims = [metric(other, f'spikeserve_store_claims_total{{outcome="{outcome}"}}') for outcome in ("claimed", "failed")]
    assert claims == [0, 0]
    assert code_of(other.GetSession, session_id="f" * 32) == grpc.StatusCode.NOT_FOUND
    owner.CloseSession(session_id=session["session_id"])
    assert code_of(other.GetSession, **session) == grpc.StatusCode.NOT_FOUND


def test_explaining_and_exporting_a_session_leave_it_to_its_owner(redis, replicas):
    owner, other = replicas
    session = {"session_id": opening(5)["session_id"]}
    for ask in (other.Explain, other.ExportSession):
        assert code_of(ask, **session) == grpc.StatusCode.NOT_FOUND
    owner.OpenSession(**opening(5))
    key = f"ss:{{{session['session_id']}}}:o"
    epoch = redis.command(f"HGET {key} epoch", database=1)
    for step in range(3):
        act(owner, 5, step)
        for method in ("Explain", "ExportSession"):
            theirs, ours = (getattr(server, method)(**session) for server in (other, owner))
            assert theirs.SerializeToString(deterministic=True) == ours.SerializeToString(deterministic=True)
    assert redis.command(f"HGET {key} epoch", database=1) == epoch
    assert metric(other, 'spikeserve_store_claims_total{outcome="claimed"}') == 0
    assert metric(owner, "spikeserve_store_fences_total") == 0


def test_a_former_owner_sends_no_answer(replicas):
    """A replica that was replaced decides, finds out, and answers UNAVAILABLE; then it has the session again."""
    first, second = replicas
    first.OpenSession(**opening(5))
    act(first, 5, 0)
    theirs = comparable(act(second, 5, 1))
    assert code_of(act, first, 5, 1) == grpc.StatusCode.UNAVAILABLE
    assert comparable(act(first, 5, 1)) == theirs
    assert metric(first, 'spikeserve_store_records_total{outcome="refused"}') == 1


def test_redis_does_not_answer(redis, replicas):
    first, second = replicas
    first.OpenSession(**opening(0))
    asynchronous = first.OpenSession(**opening(2) | {"durability": "ASYNC"}).session_id
    act(first, 0, 0)
    redis.process.send_signal(signal.SIGSTOP)
    with fails_with(grpc.StatusCode.UNAVAILABLE) as error:
        act(first, 0, 1)
    assert "grpc-status-details-bin" in dict(error.value.trailing_metadata())
    for step in range(LARGEST_LEAD):
        act(first, 2, step, asynchronous)
    assert code_of(act, first, 2, LARGEST_LEAD) == grpc.StatusCode.UNAVAILABLE
    assert metric(first, "spikeserve_store_reachable") == 0

    redis.process.send_signal(signal.SIGCONT)
    until(lambda: code_of(act, first, 0, 1) == grpc.StatusCode.OK)
    until(lambda: code_of(act, first, 2, LARGEST_LEAD) == grpc.StatusCode.OK)
    until(lambda: act(first, 2, LARGEST_LEAD).durable_decision == LARGEST_LEAD + 1)
    first.kill()
    assert second.GetSession(session_id=asynchronous).decisions == LARGEST_LEAD + 1
    assert second.GetSession(session_id=opening(0)["session_id"]).decisions == 2


def test_a_stream_decides_while_the_store_is_slow(redis, tmp_path, password):
    """Its answers wait for the store, but its next requests are decided, although the tenant has a limit."""
    with limited_server(redis, tmp_path, password, decisions_per_second=1000) as server:
        with service_with(server.addresses, "agent") as service:
            opened = [service.OpenSession(policy="cartpole").session_id for _ in range(3)]
            redis.process.send_signal(signal.SIGSTOP)
            requests = [acting(0, 0, 0) | {"session_id": session} for session in opened]
            codes = [answer.error.code for answer in stream_of(server)(requests, AGENT)]
            assert codes == [grpc.StatusCode.UNAVAILABLE.value[0]] * 3
            redis.process.send_signal(signal.SIGCONT)
            for session in opened:
                until(lambda session=session: code_of(service.GetSession, session_id=session) == grpc.StatusCode.OK)
                assert service.GetSession(session_id=session).decisions == 1


def test_a_refusal_on_a_stream_waits_for_the_answers_before_it(redis, tmp_path, password):
    with limited_server(redis, tmp_path, password, decisions_per_second=2) as server:
        with service_with(server.addresses, "agent") as service:
            session = service.OpenSession(policy="cartpole").session_id
            redis.process.send_signal(signal.SIGSTOP)
            requests = [acting(0, 0, step) | {"session_id": session} for step in range(5)]
            answers = list(stream_of(server)(requests, AGENT))
            redis.process.send_signal(signal.SIGCONT)
        assert [answer.step for answer in answers] == list(range(5))
        codes = [answer.error.code for answer in answers]
        assert codes[0] == grpc.StatusCode.UNAVAILABLE.value[0]
        assert grpc.StatusCode.RESOURCE_EXHAUSTED.value[0] in codes


@contextlib.contextmanager
def limited_server(redis, tmp_path, password, **limits):
    """Starts a server whose tenant has limits, and the token "agent"."""
    tokens = tmp_path / "tokens.json"
    tokens.write_text(json.dumps({"tenants": {"fleet": limits}, "tokens": TOKENS["tokens"][:1]}))
    flags = [f"--tokens={tokens}", password, "--durability=sync"]
    with Restartable(f"redis://127.0.0.1:{redis.port}/2", flags) as server:
        yield server


def stream_of(server):
    """Returns a function that sends requests on a stream of their own and yields its answers."""
    request_class, call = method_of(server.channel, POLICY, "ActStream")

    def answers(requests, metadata):
        messages = (request_class(**request) for request in requests)
        return call(messages, timeout=DEADLINE_SECONDS, metadata=metadata)

    return answers


def test_a_closed_session_is_closed_for_all(replicas):
    first, second = replicas
    first.OpenSession(**opening(0))
    second.CloseSession(session_id=opening(0)["session_id"])
    assert code_of(second.OpenSession, **opening(0)) == grpc.StatusCode.ALREADY_EXISTS


def test_a_former_owner_closes_the_session_for_all_or_not_at_all(redis, replicas):
    first, second = replicas
    session = {"session_id": opening(0)["session_id"]}
    first.OpenSession(**opening(0) | {"durability": "ASYNC"})
    until(lambda: act(first, 0, 0).durable_decision == 1)
    act(second, 0, 1)
    assert code_of(first.CloseSession, **session) == grpc.StatusCode.UNAVAILABLE
    assert second.GetSession(**session).decisions == 2
    first.CloseSession(**session)  # claims it, as the client library's next try does
    state = redis.command(f"HGET ss:{{{session['session_id']}}}:o state", database=1)
    assert state == b"closed"
    # The owner decides once more in memory, and finds out.
    until(lambda: code_of(act, second, 0, 2) == grpc.StatusCode.NOT_FOUND)


def test_a_replica_with_other_bytes_of_the_policy_leaves_the_session_to_its_owner(redis, tmp_path, password):
    redis.command("FLUSHALL")
    policies = tmp_path / "policies"
    shutil.copytree(SHIPPED_POLICIES / "cartpole" / "2", policies / "cartpole" / "1")
    store, flags = f"redis://127.0.0.1:{redis.port}", [password]
    with Restartable(store, flags) as owner, Restartable(store, flags, policies) as other:
        owner.OpenSession(**opening(0))
        epoch = redis.command(f"HGET ss:{{{opening(0)['session_id']}}}:o epoch")
        for step in range(4):
            with fails_with(grpc.StatusCode.UNAVAILABLE, "whose file is another one here"):
                act(other, 0, step)
            assert act(owner, 0, step).step == step
        assert metric(owner, "spikeserve_store_fences_total") == 0
        assert metric(other, 'spikeserve_store_claims_total{outcome="failed"}') == 4
        assert redis.command(f"HGET ss:{{{opening(0)['session_id']}}}:o epoch") == epoch


def test_a_replica_with_other_bytes_of_the_policy_opens_no_session_on_it(redis, tmp_path, password):
    redis.command("FLUSHALL")
    policies = tmp_path / "policies"
    shutil.copytree(SHIPPED_POLICIES / "cartpole" / "2", policies / "cartpole" / "1")
    shutil.copytree(SHIPPED_POLICIES / "cartpole" / "2", policies / "cartpole" / "2")
    store, flags = f"redis://127.0.0.1:{redis.port}", [password]

    def open_at(server, **fields):
        server.OpenSession(**{"policy": "cartpole", "version": 1, "durability": "ASYNC"} | fields)

    with Restartable(store, flags) as first, Restartable(store, flags, policies) as other:
        with fails_with(grpc.StatusCode.UNAVAILABLE, "whose file is another one here"):
            open_at(other)
        open_at(other, durability="NONE")
        open_at(other, version=2)
        open_at(first)
        shutil.copy(SHIPPED_POLICIES / "cartpole" / "1" / "policy.safetensors", policies / "cartpole" / "1")
        other.admin.ReloadPolicies()
        until(lambda: code_of(other.OpenSession, policy="cartpole", version=1) == grpc.StatusCode.OK)


def commands_of(redis):
    """Returns how many commands Redis has run."""
    info = redis.command("INFO stats").decode().splitlines()
    return int(next(line for line in info if line.startswith("total_commands_processed:")).split(":")[1])


@pytest.fixture
def server_with(redis, tmp_path, password):
    """Returns a function that makes a server with so many versions of a policy."""
    redis.command("FLUSHALL")

    def make(versions):
        policies = tmp_path / str(versions) / "cartpole"
        shutil.copytree(SHIPPED_POLICIES / "cartpole" / "1", policies / "1")
        for version in range(2, versions + 1):
            (policies / str(version)).mkdir()
            (policies / str(version) / "policy.safetensors").hardlink_to(policies / "1" / "policy.safetensors")
        return Restartable(f"redis://127.0.0.1:{redis.port}", [password], policies.parent)

    return make


@contextlib.contextmanager
def monitored(redis, words):
    """Yields a list, which has all commands with one of `words` afterwards, as MONITOR tells them."""
    commands = []
    with redis.connect() as connection:
        connection.sendall(f"AUTH {redis.password}\r\nMONITOR\r\n".encode())
        lines = connection.makefile("rb")
        assert [lines.readline() for _ in range(2)] == [b"+OK\r\n"] * 2
        yield commands
        redis.command("ECHO the-end")
        while b'"the-end"' not in (line := lines.readline()):
            if any(word in line for word in words):
                commands.append(line.partition(b"] ")[2])


def test_claims_do_not_grow_with_the_versions(redis, server_with):
    sizes = []
    for versions in (1, 64):
        with server_with(versions) as owner, server_with(versions + 1) as other:
            session = owner.OpenSession(**opening(0) | {"session_id": f"{versions:032x}"}).session_id
            with monitored(redis, [session.encode()]) as commands:
                act(other, 0, 0, session)
            sizes.append(sum(map(len, commands)))
    print(sizes)
    assert abs(sizes[1] - sizes[0]) < 64  # numbers of different lengths


def test_polling_does_not_grow_with_the_versions(redis, server_with):
    """An idle server with 256 versions asks no more of Redis than one with 32."""
    with server_with(256) as server:
        until(lambda: code_of(server.OpenSession, **opening(0)) == grpc.StatusCode.OK)
        server.CloseSession(session_id=opening(0)["session_id"])
        begin, window = commands_of(redis), 5
        time.sleep(window)  # the interval that is measured
        # Three commands for each of at most 48 logs a second, and some for the settings.
        assert commands_of(redis) - begin < window * 256


def test_sessions_may_stay_for_ever(redis, password):
    flags = [password, "--session_ttl=inf", "--store_retention=inf"]
    learning = {"scope": "FLEET", "modulator": "realized", "learning_rate": 0.5}
    with Restartable(f"redis://127.0.0.1:{redis.port}/1", flags) as server:
        session = server.OpenSession(policy="cartpole", action_selection="SAMPLE", learning=learning).session_id
        server.Act(session_id=session, observation=[0.1] * 4)
        server.EndEpisode(session_id=session, reward=1.0, terminated=True)
        server.kill()
        server.restart()
        assert server.GetSession(session_id=session).episode == 1


PLAIN, SECURE, NAMED = (f"--session_store={url}" for url in ("redis://host", "rediss://host", "redis://robot@host"))


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--store_password_file=/x"], "--store_password_file: expected none"),
        (["--store_replicas=1"], "--store_replicas: expected 0 without a store in Redis, received 1"),
        ([PLAIN, "--store_ca=/x"], "--store_ca: expected none unless --session_store begins with rediss"),
        ([SECURE, "--store_ca=/x"], "--store_ca: expected a PEM file of authorities, received /x"),
        ([SECURE, "--store_key=/x"], "--store_certificate, --store_key: expected both or none"),
        (["--store_retention=1s"], "--store_retention: expected at least"),
        ([PLAIN, "--store_timeout=0s"], "--store_timeout: expected at least 10ms, received 0"),
        ([PLAIN, "--store_timeout=inf"], "--store_timeout: expected a finite duration, received inf"),
        (["--store_user=robot"], "--store_user: expected none without a store in Redis, received robot"),
        ([NAMED, "--store_user=robot"], "--store_user: expected none, because --session_store names one"),
    ],
)
def test_flags(flags, message):
    assert message in refusal_at_start(*flags)


def test_addresses_of_stores():
    expected = "expected memory, file:DIR, redis://[USER@]HOST[:PORT][,...][/DATABASE], redis+sentinel://[USER@]HOST"
    for wrong in (
        *("redis://", "redis://host:0", "redis://host/x", "redis://a,", "redis://[::1", "redis://[::1]x", "redis://@a"),
        *("redis+sentinel://host", "redis+sentinel://host/", "redis://host/1/2", "file:", "disk"),
    ):
        assert expected in refusal_at_start(f"--session_store={wrong}")
    with_password = refusal_at_start("--session_store=redis://robot:hidden@host")
    assert "expected the password of Redis in the file of --store_password_file" in with_password
    assert "hidden" not in with_password


def test_a_server_that_stops_hands_its_sessions_over(redis, tmp_path, password):
    """SIGTERM: streams end with UNAVAILABLE, and every session has a last snapshot and no owner."""
    redis.command("FLUSHALL")
    store = f"redis://127.0.0.1:{redis.port}"
    with Restartable(store, [password]) as second, running_server(
        flags=[f"--session_store={store}", password]
    ) as addresses:
        first = addresses.agent
        for i in range(6):
            first.OpenSession(**opening(i) | {"durability": "ASYNC"})
            for step in range(5):
                act(first, i, step)
        request_class, stream = method_of(addresses.channel, POLICY, "ActStream")
        requests = queue.SimpleQueue()
        requests.put(request_class(**acting(0, 0, 5)))
        answers = stream(iter(requests.get, None))
        assert next(answers).step == 5
        epochs = [redis.command(f"HGET ss:{{{i:032x}}}:o epoch") for i in range(6)]
        addresses.process.terminate()
        assert code_of(next, answers) == grpc.StatusCode.UNAVAILABLE
        addresses.process.wait()
        for i in range(6):
            owner, epoch = redis.command(f"HMGET ss:{{{i:032x}}}:o owner epoch")
            assert (owner, epoch) == (b"", epochs[i])
            assert redis.command(f"LLEN ss:{{{i:032x}}}:{epoch.decode()}") == 1
        replayed = metric(second, "spikeserve_store_replayed_entries_total")
        for i in range(6):
            assert second.GetSession(session_id=f"{i:032x}").decisions == (6 if i == 0 else 5)
        assert metric(second, "spikeserve_store_replayed_entries_total") == replayed
        requests.put(None)


def test_what_is_counted(redis, replicas):
    first, second = replicas
    with pytest.raises(grpc.RpcError):
        act(first, 0, 0)  # an unknown session is no take-over
    first.OpenSession(**opening(5))
    for step in range(3):
        act(first, 5, step)
    act(second, 5, 3)
    assert code_of(act, first, 5, 3) == grpc.StatusCode.UNAVAILABLE
    assert metric(first, "spikeserve_store_fences_total") == 1
    assert metric(second, "spikeserve_store_replayed_entries_total") == 3
    assert metric(second, 'spikeserve_store_claims_total{outcome="claimed"}') == 1
    assert metric(first, 'spikeserve_store_claims_total{outcome="failed"}') == 0
    redis.command("FLUSHALL")
    act(second, 5, 4)
    assert metric(second, "spikeserve_store_reseeds_total") == 1


def test_an_owner_replaces_an_older_journal(redis, replicas):
    """The store has lost the last take-over: its replica took the primary's place too early."""
    first, second = replicas
    session = opening(5)["session_id"]
    first.OpenSession(**opening(5))
    act(first, 5, 0)
    former = epoch_of(redis, session)
    act(second, 5, 1)
    epoch = epoch_of(redis, session)
    assert epoch > former
    # Puts back the state before the take-over.
    redis.command(f"RENAME ss:{{{session}}}:{epoch} ss:{{{session}}}:{former}", database=1)
    redis.command(f"HSET ss:{{{session}}}:o epoch {former} owner former", database=1)
    act(second, 5, 2)
    second.kill()
    until(lambda: code_of(act, first, 5, 3) == grpc.StatusCode.OK)
    assert first.GetSession(session_id=session).decisions == 4


def epoch_of(redis, session):
    return int(redis.command(f"HGET ss:{{{session}}}:o epoch", database=1))
