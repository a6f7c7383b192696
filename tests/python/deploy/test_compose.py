"""The services of deploy/compose/compose.yaml run together, and an agent does not notice that a replica is killed."""

import json
import os
import pathlib
import shutil
import socket
import subprocess
import sys
import urllib.parse
import urllib.request

import pytest

ROOT = pathlib.Path(__file__).parents[3]
sys.path.insert(0, str(ROOT))

import spikeserve  # noqa: E402
import yaml  # noqa: E402
from redis_servers import read_reply  # noqa: E402
from security import until  # noqa: E402
from serving import DEADLINE_SECONDS, SHIPPED_POLICIES, running_server  # noqa: E402

from tests.compose.layout import COMPOSE, PASSWORD, Layout, enter  # noqa: E402

ENVOY = ROOT / "build/interop/bin/envoy"
STEPS = 120

MAY_MAKE_NAMESPACES = subprocess.run(["unshare", "--net", "--mount", "true"], capture_output=True).returncode == 0

if "COMPOSE_NAMESPACE" not in os.environ:

    @pytest.mark.skipif(not MAY_MAKE_NAMESPACES, reason="making namespaces is not permitted")
    @pytest.mark.skipif(not ENVOY.exists(), reason="without Envoy")
    @pytest.mark.skipif(shutil.which("redis-server") is None, reason="without redis-server")
    def test_in_namespaces():
        """Runs the other tests of this file in namespaces of their own."""
        assert enter(["-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", __file__]) == 0


inside = pytest.mark.skipif("COMPOSE_NAMESPACE" not in os.environ, reason="in namespaces of its own")


@pytest.fixture(scope="module")
def layout(tmp_path_factory):
    programs = {
        "spikeserve": [os.environ["SPIKESERVE_PROGRAM"]],
        "redis": [],  # its command names the program
        "envoyproxy/envoy": ["env", f"PATH={ENVOY.parent}:/usr/bin:/bin"],
        "prom/prometheus": ["prometheus"],
    }
    started = Layout(tmp_path_factory.mktemp("layout"), programs, SHIPPED_POLICIES)
    try:
        until(lambda: epochs(started, "replica-a") == [])
        until(lambda: epochs(started, "replica-b") == [])
        yield started
    finally:
        started.close()


def get(url):
    with urllib.request.urlopen(url, timeout=DEADLINE_SECONDS) as page:
        return json.loads(page.read())


def epochs(layout, replica):
    """Returns the epochs of the sessions that a replica has, or None if it does not answer."""
    try:
        sessions = get(f"http://{layout.services[replica].address}:9464/sessions.json")["sessions"]
    except OSError:
        return None
    return [int(session["epoch"]) for session in sessions]


def owner(layout):
    """Returns the replica that has the session. A former owner may still list it, with an older epoch."""
    return max(("replica-a", "replica-b"), key=lambda name: max(epochs(layout, name) or [-1]))


def query(layout, expression):
    url = f"http://{layout.services['prometheus'].address}:9090/api/v1/query?"
    try:
        result = get(url + urllib.parse.urlencode({"query": expression}))["data"]["result"]
    except OSError:
        return None
    return [float(series["value"][1]) for series in result]


def play(address, disturb=lambda step: None, durability="SYNC"):
    """Returns the actions and spikes of one session of an agent that knows one address."""
    options = spikeserve.ClientOptions(timeout=DEADLINE_SECONDS, connect_timeout=DEADLINE_SECONDS)
    with spikeserve.Client(address, options) as client:
        session = client.open_session("cartpole", spikeserve.SessionOptions(seed=7, durability=durability))
        decisions = []
        for step in range(STEPS):
            disturb(step)
            decision = session.act([0.01 * (step % 7), 0.0, 0.02, -0.01 * (step % 5)], reward=1.0)
            decisions.append((decision.action, decision.stats.spikes))
        return decisions


@inside
def test_an_agent_does_not_notice_that_a_replica_is_killed(layout):
    """Kills the replica that has the session, whichever it is, and the other one later."""
    killed = []

    def disturb(step):
        if step in (30, 80):
            killed.append(owner(layout))
            layout.services[killed[-1]].kill()
        if step == 70:  # as `restart: unless-stopped` does
            layout.services[killed[0]].start()
            until(lambda: epochs(layout, killed[0]) is not None)

    with running_server() as alone:
        undisturbed = play(alone.grpc, durability="NONE")
    assert play(f"{layout.services['balancer'].address}:50051", disturb) == undisturbed
    assert len(killed) == 2
    layout.services[killed[1]].start()


@inside
def test_prometheus_scrapes_both_replicas_and_evaluates_the_alerts(layout):
    until(lambda: query(layout, 'up{job="spikeserve"}') == [1.0, 1.0])
    rules = get(f"http://{layout.services['prometheus'].address}:9090/api/v1/rules")
    assert sum(len(group["rules"]) for group in rules["data"]["groups"]) >= 7


@inside
def test_redis_keeps_what_it_acknowledges(layout):
    with socket.create_connection((layout.services["redis"].address, 6379)) as connection:
        lines = connection.makefile("rb")
        connection.sendall(b"PING\r\n")
        assert lines.readline().startswith(b"-NOAUTH")
        connection.sendall(b"AUTH %s\r\n" % PASSWORD.encode())
        assert lines.readline() == b"+OK\r\n"
        connection.sendall(b"CONFIG GET appendfsync\r\nCONFIG GET appendonly\r\n")
        assert [read_reply(lines), read_reply(lines)] == [[b"appendfsync", b"always"], [b"appendonly", b"yes"]]


def test_nobody_logs_in_to_grafana():
    """Grafana's own password is known to everyone."""
    compose = yaml.safe_load((COMPOSE / "compose.yaml").read_text())
    environment = compose["services"]["grafana"]["environment"]
    assert environment["GF_SECURITY_DISABLE_INITIAL_ADMIN_CREATION"] == "true"
    assert "GF_AUTH_ANONYMOUS_ORG_ROLE" not in environment  # a viewer
    for service in compose["services"].values():
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", []))


def test_grafana_finds_the_data_source_and_the_dashboard():
    services = yaml.safe_load((COMPOSE / "compose.yaml").read_text())["services"]
    [source] = yaml.safe_load((COMPOSE / "grafana/datasources/prometheus.yaml").read_text())["datasources"]
    host = urllib.parse.urlparse(source["url"])
    assert (services[host.hostname]["image"].split(":")[0], host.port) == ("prom/prometheus", 9090)
    [provider] = yaml.safe_load((COMPOSE / "grafana/dashboards/spikeserve.yaml").read_text())["providers"]
    mounted = {volume.split(":")[1]: COMPOSE / volume.split(":")[0] for volume in services["grafana"]["volumes"]}
    assert (mounted[provider["options"]["path"]] / "spikeserve.json").exists()
    for target, path in mounted.items():
        assert path.exists(), target
