"""Sessions survive in Redis over TLS, behind Sentinels, and in a Cluster."""

import contextlib

import grpc
import pytest
from links import Link
from redis_servers import (
    PASSWORD,
    WITHOUT_REDIS,
    Redis,
    Sentinel,
    is_watched,
    make_certificates,
    move_slot,
    node_id,
    primary_port,
    start_cluster,
    stopping,
)
from security import code_of, until
from stored_sessions import (
    EPISODES,
    SESSIONS,
    STEPS,
    Restartable,
    acting,
    comparable,
    decisions,
    ending,
    opening,
    play,
    undisturbed_answers,
    undisturbed_play,
    until_answered,
)

pytestmark = WITHOUT_REDIS


@pytest.fixture(scope="module")
def undisturbed():
    return undisturbed_play()


def play_patiently(service, disturb):
    """As play(), but with one call for each decision, which is repeated until it is answered."""
    answers = {i: [] for i in range(SESSIONS)}
    for i in range(SESSIONS):
        until_answered(lambda i=i: service().OpenSession(**opening(i)))
    for episode in range(EPISODES):
        for step in range(STEPS):
            disturb(episode, step)
            for i in range(SESSIONS):
                answer = until_answered(lambda i=i: service().Act(**acting(i, episode, step)))
                answers[i].append(comparable(answer))
        for i in range(SESSIONS):
            ended = until_answered(lambda i=i: service().EndEpisode(**ending(i, episode)))
            answers[i].append(ended.SerializeToString(deterministic=True))
    for i in range(SESSIONS):
        view = until_answered(
            lambda i=i: service().GetSession(session_id=f"{i:032x}", include_head_delta=True)
        )
        answers[i].append(view.SerializeToString(deterministic=True))
    return answers


def test_tls(tmp_path, password, undisturbed):
    certificates = make_certificates(tmp_path)
    with stopping([Redis(certificates=certificates)]) as [redis]:
        flags = [
            *(password, f"--store_ca={certificates}/ca.pem"),
            *(f"--store_certificate={certificates}/client.pem", f"--store_key={certificates}/client.key"),
        ]
        with Restartable(f"rediss://localhost:{redis.port}", flags) as server:

            def disturb(episode, step):
                if (episode, step) == (0, 20):
                    server.restart()

            assert play(lambda: server, disturb) == undisturbed


def test_tls_with_strangers(tmp_path, password):
    """A Redis server that another authority signed, or that has another name, is not used."""
    certificates = make_certificates(tmp_path)
    mine = [f"--store_certificate={certificates}/client.pem", f"--store_key={certificates}/client.key"]
    log = tmp_path / "log"
    with stopping([Redis(certificates=certificates)]) as [redis]:
        for flags, host, expected in (
            ([*mine, f"--store_ca={certificates}/stranger.pem"], "localhost", "self-signed certificate"),
            ([*mine, f"--store_ca={certificates}/ca.pem"], "[::ffff:127.0.0.1]", "IP address mismatch"),
            ([f"--store_ca={certificates}/ca.pem"], "localhost", "tlsv13 alert certificate required"),
        ):
            with Restartable(f"rediss://{host}:{redis.port}", [password, *flags], log=log) as server:
                until(lambda: code_of(server.OpenSession, **opening(0)) == grpc.StatusCode.UNAVAILABLE)
                until(lambda expected=expected: expected in log.read_text())


# What a server needs, and no more.
GRANTS = "~ss:* ~cfg ~r ~fl:* ~fs:* ~fc:* ~fm:* ~pf:* ~us:* +@all -@admin -@dangerous +role +info +config|get"


@pytest.mark.parametrize("by_flag", [False, True])
def test_a_user_of_the_access_control_list(tmp_path, password, undisturbed, by_flag):
    """The default user may do nothing. Another one has the keys of the server."""
    with stopping([Redis()]) as [redis]:
        assert redis.command(f"ACL SETUSER robots on >robots-secret {GRANTS}") == b"OK"
        file = tmp_path / "robots"
        file.write_text("robots-secret\n")
        flags = [f"--store_password_file={file}", "--usage_interval=50ms"] + ["--store_user=robots"] * by_flag
        user = "" if by_flag else "robots@"
        with Restartable(f"redis://{user}127.0.0.1:{redis.port}/3", flags) as server:
            assert play(lambda: server) == undisturbed
            until(lambda: len(server.admin.GetUsage().rows) > 0)
        assert redis.command("DBSIZE", database=3) > 0
        log = tmp_path / "log"
        file.write_text("another")
        with Restartable(f"redis://{user}127.0.0.1:{redis.port}", flags, log=log) as server:
            assert code_of(server.OpenSession, **opening(0)) == grpc.StatusCode.UNAVAILABLE
            assert "WRONGPASS" in log.read_text()


def test_a_user_of_redis_whom_sentinels_do_not_know(tmp_path):
    with stopping([Redis()]) as servers:
        [redis] = servers
        assert redis.command(f"ACL SETUSER robots on >robots-secret {GRANTS}") == b"OK"
        file = tmp_path / "robots"
        file.write_text("robots-secret\n")
        sentinel = Sentinel(tmp_path, redis, quorum=1)
        servers.append(sentinel)
        until(lambda: primary_port(sentinel) == redis.port)
        store = f"redis+sentinel://robots@127.0.0.1:{sentinel.port}/mymaster"
        with Restartable(store, [f"--store_password_file={file}"]) as server:
            until(lambda: code_of(server.OpenSession, **opening(0)) == grpc.StatusCode.OK)


def test_a_redis_that_is_far_away(password):
    """Its answers take 1.2 s."""
    with stopping([Redis()]) as [redis], Link(f"127.0.0.1:{redis.port}", delay=0.6) as link, Restartable(
        f"redis://{link.address}", [password, "--store_timeout=20s"]
    ) as server:
        until(lambda: code_of(server.OpenSession, **opening(0)) in (grpc.StatusCode.OK, grpc.StatusCode.ALREADY_EXISTS))
        session = opening(0)["session_id"]
        until(lambda: redis.command(f"HGET ss:{{{session}}}:o state") == b"open")
        until(lambda: code_of(server.Act, **acting(0, 0, 0)) == grpc.StatusCode.OK)


def test_sentinels_name_the_new_primary(tmp_path, password, undisturbed):
    """The primary is killed. Nothing that a replica of Redis was to have is lost."""
    with stopping([Redis()]) as servers:
        primary = servers[0]
        servers += [Redis("--replicaof", "127.0.0.1", str(primary.port)) for _ in range(2)]
        until(lambda: b"connected_slaves:2" in primary.command("INFO replication"))
        sentinels = [Sentinel(tmp_path, primary, quorum=2) for _ in range(3)]
        servers += sentinels
        until(lambda: all(primary_port(each) == primary.port for each in sentinels))
        addresses = ",".join(f"127.0.0.1:{each.port}" for each in sentinels)
        for each in sentinels:
            until(lambda each=each: is_watched(each, replicas=2, sentinels=2))
        flags = [password, "--store_replicas=1"]
        with Restartable(f"redis+sentinel://{addresses}/mymaster/2", flags) as server:

            def disturb(episode, step):
                if (episode, step) == (0, 15):
                    primary.kill()
                if (episode, step) == (1, 5):
                    server.restart()  # what the new primary has is all there is

            assert play_patiently(lambda: server, disturb) == undisturbed
            assert primary_port(sentinels[0]) != primary.port


def test_too_few_replicas(password):
    with stopping([Redis()]) as servers:
        [primary] = servers
        flags = [password, "--store_replicas=1"]
        with Restartable(f"redis://127.0.0.1:{primary.port}", flags) as server:
            assert code_of(server.OpenSession, **opening(0)) == grpc.StatusCode.UNAVAILABLE
            servers.append(Redis("--replicaof", "127.0.0.1", str(primary.port)))
            until(lambda: code_of(server.OpenSession, **opening(0)) == grpc.StatusCode.OK)


def test_a_replica_of_redis_is_no_store(password):
    """Of several addresses, the one that takes writes is used."""
    with stopping([Redis()]) as servers:
        [primary] = servers
        servers.append(Redis("--replicaof", "127.0.0.1", str(primary.port)))
        addresses = f"127.0.0.1:{servers[1].port},127.0.0.1:{primary.port}"
        until(lambda: b"role:slave" in servers[1].command("INFO replication"))
        with Restartable(f"redis://{addresses}", [password]) as server:
            until(lambda: code_of(server.OpenSession, **opening(0)) == grpc.StatusCode.OK)


def test_cluster_whose_slots_move(password, undisturbed):
    """While the sessions are played, the slots of all their keys move to other nodes."""
    with stopping([]) as servers:
        start_cluster(servers)
        with Restartable(f"redis://127.0.0.1:1,127.0.0.1:{servers[1].port}", [password]) as server:

            def disturb(episode, step):
                if (episode, step) == (0, 10):
                    for i in range(0, SESSIONS, 4):
                        move(i, servers)
                if (episode, step) == (1, 10):
                    server.restart()
                if (episode, step) == (1, 20):  # commands on the other half are sent on by ASK
                    for i in range(1, SESSIONS, 4):
                        begin_to_move(i, servers)

            assert play_patiently(lambda: server, disturb) == undisturbed
            assert sum(holds(each) for each in servers) == 3


@pytest.mark.parametrize("which", [0, -1])
def test_a_half_moved_slot_is_unavailable(password, which):
    """One key of a session has moved and the others have not: clients are to try again, and nothing is lost."""
    with stopping([]) as servers:
        start_cluster(servers)
        with Restartable(f"redis://127.0.0.1:{servers[0].port}", [password]) as server:
            until(lambda: code_of(server.OpenSession, **opening(0)) == grpc.StatusCode.OK)
            server.OpenSession(**opening(0))
            server.Act(**acting(0, 0, 0))
            slot = slot_of(0, servers)
            source = owner_of(slot, servers)
            target = other_than(source, servers)
            keys = source.command(f"CLUSTER GETKEYSINSLOT {slot} 100")
            assert len(keys) > 1
            move_slot(slot, source, target, servers, finish=False, keys=[sorted(keys)[which]])
            server.restart()
            until(lambda: code_of(server.OpenSession, **opening(1)) == grpc.StatusCode.OK)
            assert code_of(server.Act, **acting(0, 0, 1)) == grpc.StatusCode.UNAVAILABLE
            move_slot(slot, source, target, servers)
            until(lambda: code_of(server.Act, **acting(0, 0, 1)) == grpc.StatusCode.OK)


def test_a_snapshot_in_a_slot_that_is_about_to_move(password):
    """All keys of the session are still at their node, which refuses those that it does not have."""
    with stopping([]) as servers:
        start_cluster(servers)
        with Restartable(f"redis://127.0.0.1:{servers[0].port}", [password]) as server:
            until(lambda: code_of(server.OpenSession, **opening(0)) == grpc.StatusCode.OK)
            answers = decisions(server, 0, 0, 12)
            slot = slot_of(0, servers)
            source = owner_of(slot, servers)
            target = other_than(source, servers)
            target.command(f"CLUSTER SETSLOT {slot} IMPORTING {node_id(source)}")
            source.command(f"CLUSTER SETSLOT {slot} MIGRATING {node_id(target)}")
            with contextlib.suppress(grpc.RpcError):
                while len(answers) < 20:
                    answers.append(comparable(server.Act(**acting(0, 0, len(answers)))))
            server.kill()
            for node in (source, target):
                node.command(f"CLUSTER SETSLOT {slot} STABLE")
            server.restart()
            answers += decisions(server, 0, len(answers), 24)
            assert answers == undisturbed_answers([0])[0][:24]


def test_a_half_moved_slot_holds_no_other_session(password):
    """The snapshot of one session is refused. Others decide, open and are claimed, without a single refusal."""
    others = range(2, 40, 2)
    with stopping([]) as servers:
        start_cluster(servers)
        with Restartable(f"redis://127.0.0.1:{servers[0].port}", [password]) as server:
            for i in (0, *others):
                until(lambda i=i: code_of(server.OpenSession, **opening(i)) == grpc.StatusCode.OK)
            answers = decisions(server, 0, 0, 12)
            slot = slot_of(0, servers)
            source = owner_of(slot, servers)
            target = other_than(source, servers)
            list_ = next(key for key in source.command(f"CLUSTER GETKEYSINSLOT {slot} 100") if not key.endswith(b":o"))
            move_slot(slot, source, target, servers, finish=False, keys=[list_])
            with contextlib.suppress(grpc.RpcError):
                while True:
                    answers.append(comparable(server.Act(**acting(0, 0, len(answers)))))
            step = len(answers)
            for other_step in range(STEPS):
                for i in others:
                    assert code_of(server.Act, **acting(i, 0, other_step)) == grpc.StatusCode.OK
                if other_step == STEPS // 2:
                    server.restart()
                assert code_of(server.Act, **acting(0, 0, step)) == grpc.StatusCode.UNAVAILABLE
            assert code_of(server.OpenSession, **opening(40)) == grpc.StatusCode.OK
            move_slot(slot, source, target, servers)
            answers += decisions(server, 0, step, 24)
            assert answers == undisturbed_answers([0])[0][:24]


def test_a_renewed_password_is_read_again(tmp_path):
    """Redis has another password from now on, and closes its connections."""
    file = tmp_path / "password"
    file.write_text(PASSWORD)
    with stopping([Redis()]) as [redis], Restartable(
        f"redis://127.0.0.1:{redis.port}", [f"--store_password_file={file}"]
    ) as server:
        server.OpenSession(**opening(0))
        assert redis.command("CONFIG SET requirepass renewed") == b"OK"
        redis.password = "renewed"
        redis.command("CLIENT KILL TYPE normal SKIPME yes")
        until(lambda: code_of(server.Act, **acting(0, 0, 0)) == grpc.StatusCode.UNAVAILABLE)
        file.write_text("renewed")
        until(lambda: code_of(server.Act, **acting(0, 0, 0)) == grpc.StatusCode.OK)


def holds(server):
    return server.command("DBSIZE") > 0


def slot_of(i, servers):
    return servers[0].command(f"CLUSTER KEYSLOT ss:{{{i:032x}}}:o")


def owner_of(slot, servers):
    def owns(server):
        return server.command(f"CLUSTER COUNTKEYSINSLOT {slot}") > 0

    return next(server for server in servers if owns(server))


def other_than(server, servers):
    return servers[(servers.index(server) + 1) % len(servers)]


def move(i, servers):
    slot = slot_of(i, servers)
    source = owner_of(slot, servers)
    move_slot(slot, source, other_than(source, servers), servers)


def begin_to_move(i, servers):
    """Moves the keys, but not the slot."""
    slot = slot_of(i, servers)
    source = owner_of(slot, servers)
    move_slot(slot, source, other_than(source, servers), servers, finish=False)


def test_cluster_has_one_database(tmp_path, password):
    log = tmp_path / "log"
    with stopping([]) as servers:
        start_cluster(servers)
        with Restartable(f"redis://127.0.0.1:{servers[0].port}/3", [password], log=log) as server:
            assert code_of(server.OpenSession, **opening(0)) == grpc.StatusCode.UNAVAILABLE
            assert "SELECT is not allowed in cluster mode" in log.read_text()
