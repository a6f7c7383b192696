"""Two replicas behind nginx, HAProxy and Envoy, with the configurations of deploy/: a lost replica is not noticed."""

import asyncio
import contextlib
import pathlib
import sys

import grpc
import pytest
import spikeserve
import test_replicas
from deployed_proxies import PROXIES, installed, running
from redis_servers import free_port
from replicated import SESSIONS, options_of, policy_of, running_fleet
from security import until
from serving import DEADLINE_SECONDS, run
from test_cpp_replicas import CppCalls, CppStreams
from test_replicas import AsyncStreams, Calls, Streams, undisturbed  # noqa: F401

OPTIONS = spikeserve.ClientOptions(
    timeout=2.0, connect_timeout=DEADLINE_SECONDS, retry=spikeserve.RetryOptions(max_elapsed=60)
)


def in_front(name, path, port, certificates, replicas):
    """Runs a proxy that listens on localhost and asks the replicas."""
    parts = {}
    if name == "nginx":
        file = "spikeserve-replicas.conf"
        parts = {f"10.0.0.{i + 1}:50051": replica.address for i, replica in enumerate(replicas)}
        parts["listen 443"] = f"listen 127.0.0.1:{port}"
    elif name == "haproxy":
        file = "haproxy-replicas.cfg"
        server = "{} proto h2 check check-proto h1 port {}".format
        for i, replica in enumerate(replicas):
            http_port = replica.http_address.rpartition(":")[2]
            parts[server(f"10.0.0.{i + 1}:50051", 9464)] = server(replica.address, http_port)
        parts["bind :443"] = f"bind 127.0.0.1:{port}"
    else:
        file = "envoy-replicas.yaml"
        address = "address: {}, port_value: {}".format
        for i, replica in enumerate(replicas):
            parts[address(f"10.0.0.{i + 1}", 50051)] = address(*replica.address.rsplit(":", 1))
        parts[address("0.0.0.0", 443)] = address("127.0.0.1", port)
    return running(name, file, path, certificates, parts)


@pytest.fixture(scope="module")
def fleet():
    installed("redis-server")
    with running_fleet(replicas=2, http=True) as started:
        yield started


@pytest.fixture(scope="module")
def root(certificates):
    return certificates / "ca.pem"


@pytest.fixture(scope="module", params=PROXIES)
def address(fleet, certificates, request, tmp_path_factory):
    """Starts a proxy in front of the replicas, all of which it has found, and yields its address."""
    port = free_port()
    path = tmp_path_factory.mktemp("proxy")
    with in_front(request.param, path, port, certificates, fleet.replicas):
        yield f"localhost:{port}"


def play(address, root, player_class, disturb=lambda t: None):
    """Plays all sessions through a proxy, once it has found a replica, and returns what they answered."""
    credentials = grpc.ssl_channel_credentials(pathlib.Path(root).read_bytes())

    def is_ready():
        with spikeserve.Client(address, OPTIONS, credentials) as client:
            with contextlib.suppress(spikeserve.SpikeserveError):
                return client.list_policies()

    until(is_ready)
    levels = ["ASYNC"] * 4 + ["SYNC"] * 4
    return asyncio.run(test_replicas.play(address, player_class, levels, disturb, OPTIONS, credentials))


def sessions_at(replica):
    """Returns the sessions that a replica has, with their epochs."""
    with spikeserve.AdminClient(replica.address) as admin:
        return {session.session_id: session.epoch for session in admin.list_sessions().sessions}


class RoutedStreams(Streams):
    """Opens the sessions with the route of the stream, so that they need not move to its replica."""

    async def open(self, i, durability):
        options = options_of(i, durability)
        return self.client.open_session(policy_of(i), options, route=self.stream.route)


@pytest.mark.parametrize("player", [Calls, RoutedStreams], ids=lambda player: player.__name__)
def test_a_session_stays_at_its_replica(address, fleet, root, player):
    """The calls of a session, or of a stream, reach one replica: no session is ever claimed."""
    # A former owner keeps its copy of a session that was closed elsewhere until its time-to-live ends.
    former = [sessions_at(replica).keys() for replica in fleet.replicas]
    opened, found = {}, []

    def look(t):
        seen = [sessions_at(replica) for replica in fleet.replicas]
        if t == 0:
            opened.update(seen[0] | seen[1])
        found[:] = seen

    play(address, root, player, look)
    first, second = ({key: epochs[key] for key in epochs.keys() - old} for epochs, old in zip(found, former, strict=True))
    assert not first.keys() & second.keys()
    assert len(first) + len(second) == SESSIONS
    assert all(opened[key] == epoch for key, epoch in (first | second).items())
    # Single sessions are spread; those of a stream are together.
    assert bool(first and second) == (player is Calls)


PLAYERS = [Calls, Streams, AsyncStreams, CppCalls, CppStreams]


@pytest.mark.parametrize("player", PLAYERS, ids=lambda player: player.__name__)
def test_sessions_go_on(address, fleet, root, undisturbed, player):  # noqa: F811
    """Each replica is killed, and each is drained and started again, while sessions play."""
    player.more = (root,)
    first, second = fleet.replicas
    disturbances = {
        7: first.kill,
        20: lambda: (first.start(), second.kill()),
        37: second.start,
        45: first.restart,
        52: second.restart,
    }
    try:
        answers = play(address, root, player, lambda t: disturbances.get(t, lambda: None)())
    except BaseException:
        for replica in fleet.replicas:  # one may have been left killed, and the next test needs both
            replica.kill()
            replica.start()
        raise
    finally:
        player.more = ()
    assert answers == undisturbed


def test_a_decision_is_shown_from_the_agent_to_redis():
    """`make trace`."""
    installed("nginx")
    shown = run(sys.executable, "-m", "tests.tracing", cwd=pathlib.Path(__file__).parents[3]).stdout
    names = [line.split()[0] for line in shown.splitlines() if line.startswith("    ")]
    assert names == ["decide", "append", "claim", "decide", "append"]
