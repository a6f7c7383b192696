"""Checks the shipped dashboard and alerts with a real server that a real Prometheus scrapes."""

import contextlib
import json
import math
import os
import pathlib
import re
import shutil
import subprocess
import time
import urllib.parse
import urllib.request

import grpc
import pytest

from documentation import page_of
from redis_servers import Redis, stopping
from security import code_of, until
from serving import DEADLINE_SECONDS, DEPLOY, SHIPPED_POLICIES, TEST_TIME, run, running_server

PROMETHEUS_YML = DEPLOY / "prometheus" / "prometheus.yml"
ALERTS_YML = DEPLOY / "prometheus" / "alerts.yml"
UNIT = DEPLOY / "systemd" / "spikeserve.service.in"
DASHBOARD = json.loads((DEPLOY / "grafana" / "spikeserve.json").read_text())
PANELS = [panel for panel in DASHBOARD["panels"] if panel["type"] != "row"]
TARGETS = [(panel["title"], target) for panel in PANELS for target in panel["targets"]]

# The tests make no such call, because Service calls unary methods only.
ABSENT = {"ActStream"}

# The labels that Prometheus adds to every series.
SCRAPE_LABELS = {"job", "instance"}
# What Prometheus makes itself, with the labels of its own.
OF_PROMETHEUS = {"up": set(), "ALERTS": {"alertname", "alertstate"}}
# What only a server whose tenants have budgets exports (operate/test_usage.py).
OF_BUDGETS = {"spikeserve_budget_ratio": {"tenant", "budget"}}
STEPS = 5  # of an episode
OBSERVATION = [0.01, -0.02, 0.03, 0.1]


def get(url, **parameters):
    query = f"?{urllib.parse.urlencode(parameters)}" if parameters else ""
    with urllib.request.urlopen(url + query, timeout=DEADLINE_SECONDS) as response:
        return response.read().decode()


class Prometheus:
    """The HTTP API of Prometheus."""

    def __init__(self, address):
        self._url = f"http://{address}/api/v1"

    def query(self, expression):
        """Returns the series of an instant vector or scalar, as (labels, value) pairs."""
        data = json.loads(get(f"{self._url}/query", query=expression))["data"]
        return [(series["metric"], float(series["value"][1])) for series in data["result"]]

    def rules(self):
        groups = json.loads(get(f"{self._url}/rules"))["data"]["groups"]
        return [rule for group in groups for rule in group["rules"]]


@contextlib.contextmanager
def running_prometheus(directory, target):
    """Starts Prometheus with the shipped configuration, another target and shorter intervals."""
    configuration = PROMETHEUS_YML.read_text()
    for shipped, here in (("127.0.0.1:9464", target), ("_interval: 15s", f"_interval: {200 * TEST_TIME}ms")):
        assert shipped in configuration
        configuration = configuration.replace(shipped, here)
    (directory / "prometheus.yml").write_text(configuration)
    shutil.copy(ALERTS_YML, directory)
    process = subprocess.Popen(
        [
            "prometheus",
            f"--config.file={directory / 'prometheus.yml'}",
            f"--storage.tsdb.path={directory / 'data'}",
            "--web.listen-address=127.0.0.1:0",
        ],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        address, log = None, []
        for line in process.stderr:
            log.append(line)
            if listening := re.search(r'msg="Listening on" address=(\S+)', line):
                address = listening[1]
            if "Server is ready" in line:
                break
        else:
            pytest.fail("Prometheus did not start:\n" + "".join(log))
        yield Prometheus(address)
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


def play_robot(service):
    """Plays as a robot on a bad link. Its session stays open."""
    session = service.OpenSession(policy="cartpole", period_seconds=0.02).session_id
    report = {"fresh": 5, "held": 1, "local": 1, "safe": 1, "late_answers": 1, "oldest_age_seconds": 0.1}
    times = {"observed_at": 10**12, "valid_until": 2 * 10**12}
    beat = {"session_id": session, "step": 0, "decision": 0, "observation": OBSERVATION}
    service.Act(**beat, **times, report=report)
    service.Act(**beat)
    history = [{"step": 0, "observation": OBSERVATION, "executed": {"discrete": 0}}]
    late = {"observed_at": 10**12 - 5 * 10**9, "valid_until": 10**12 - 4 * 10**9}
    service.Act(**(beat | {"step": 1, "decision": 1}), history=history, **late)


def play(service):
    """Plays two episodes and makes one call for each kind of error. Leaves its session open."""
    session = service.OpenSession(policy="cartpole").session_id
    for _ in range(2):
        for step in range(STEPS):
            service.Act(session_id=session, step=step, observation=OBSERVATION, reward=1.0)
        service.EndEpisode(session_id=session, reward=1.0, terminated=True)
    play_robot(service)
    for mistake, code in (
        ({"session_id": "nobody"}, grpc.StatusCode.NOT_FOUND),
        ({"session_id": session, "step": 7}, grpc.StatusCode.FAILED_PRECONDITION),
        ({"session_id": session, "observation": [1.0]}, grpc.StatusCode.INVALID_ARGUMENT),
    ):
        assert code_of(service.Act, **{"observation": OBSERVATION, **mistake}) == code


def roll_out_in_vain(agent, admin):
    """Rolls out version 2 of cartpole, whose returns are worse here, until the server aborts it."""
    admin.SetDefaultVersion(policy="cartpole", version=1)
    admin.StartRollout(policy="cartpole", version=2, steps=[50])

    def aborted():
        for _ in range(10):
            session = agent.OpenSession(policy="cartpole")
            agent.Act(session_id=session.session_id, observation=OBSERVATION)
            agent.EndEpisode(
                session_id=session.session_id, reward=2 - session.version, terminated=True
            )
            agent.CloseSession(session_id=session.session_id)
        return admin.ListRollouts().rollouts[0].state == 3  # STATE_ABORTED

    until(aborted)
    admin.SetDefaultVersion(policy="cartpole", version=2)


def shadow(agent, admin, address):
    """Lets version 3 of cartpole, which decides differently, shadow version 2."""
    admin.SetShadow(policy="cartpole", shadow_version=3)
    session = agent.OpenSession(policy="cartpole").session_id
    for step in range(200):
        angle = (step % 20 - 10) / 100
        observation = [0.0, 0.0, angle, -angle * (step % 7)]
        agent.Act(session_id=session, step=step, observation=observation, reward=1.0)
    agent.CloseSession(session_id=session)
    until(lambda: 'agreement="differ"' in get(f"http://{address}/metrics"))


def test_versions_without_a_session_have_hardly_any_series():
    with running_server() as addresses:
        lines = [line for line in get(f"http://{addresses.http}/metrics").splitlines() if not line.startswith("#")]
    assert len(lines) < 200
    names = {line.partition("{")[0] for line in lines if 'policy="' in line}
    assert names <= {
        "spikeserve_policy_info",
        "spikeserve_non_finite_answers_total",
        "spikeserve_policy_traffic_ratio",
        "spikeserve_head_held_out_sessions",
        "spikeserve_head_trimmed_contributions",
    }


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """Starts a server, plays with it, operates it and yields its addresses."""
    policies = tmp_path_factory.mktemp("policies") / "policies"
    shutil.copytree(SHIPPED_POLICIES, policies)
    shutil.copytree(policies / "cartpole-small" / "1", policies / "cartpole" / "3")
    with (
        stopping([Redis(password="")]) as [redis],
        running_server(policies, flags=[f"--session_store=redis://127.0.0.1:{redis.port}"]) as addresses,
    ):
        roll_out_in_vain(addresses.agent, addresses.admin)
        shadow(addresses.agent, addresses.admin, addresses.http)
        play(addresses.agent)
        yield addresses


@pytest.fixture(scope="module")
def scraped(server):
    """Reads /metrics. Returns the labels of every series, by metric."""
    metrics = {}
    for line in get(f"http://{server.http}/metrics").splitlines():
        if not line.startswith("#"):
            name, labels = re.fullmatch(r"([a-z_:]+)(?:\{(.*)\})? \S+", line).groups()
            metrics.setdefault(name, []).append(dict(re.findall(r'(\w+)="([^"]*)"', labels or "")))
    return metrics


@pytest.fixture(scope="module")
def prometheus(server, tmp_path_factory):
    """Starts a Prometheus that scrapes the server before and after the second `play`."""
    with running_prometheus(tmp_path_factory.mktemp("prometheus"), server.http) as api:
        # A rate needs two samples of every series.
        errors = 'spikeserve_rpc_duration_seconds_count{code="INVALID_ARGUMENT"}'
        decisions = 'spikeserve_decisions_total{policy="cartpole",version="2"}'
        [(_, before)] = until(lambda: api.query(errors))  # the first scrape
        [(_, decided)] = until(lambda: api.query(decisions))
        play(server.agent)
        until(lambda: api.query(f"{errors} > {before}"))
        # The first play's last error may have been counted after the first scrape, and be the one that is seen.
        until(lambda: api.query(f"{decisions} >= {decided + 2 * STEPS}"))
        # The shadow computes later than the answers, and later still on a busy machine.
        shadowed = "increase(spikeserve_shadow_decisions_total[1m]) > 0"
        until(lambda: api.query(shadowed))
        until(lambda: all(rule["health"] == "ok" for rule in api.rules()))
        until(lambda: api.query('ALERTS{alertname="SpikeserveRolloutAborted"}'))
        yield api


def fill_in(expression, instance):
    """Returns the expression of a panel with the variables replaced, as Grafana sends it."""
    for variable, value in (
        ("$policy", "cartpole"),
        ("$version", "2"),
        ("$instance", instance),
        ("$__rate_interval", "1m"),
    ):
        expression = expression.replace(variable, value)
    assert "$" not in expression, f"expression: expected known variables, received {expression}"
    return expression


def names_and_labels(expression):
    """Returns the metrics of an expression with their label matchers, and its grouping labels."""
    selectors = re.findall(r"\b((?:spikeserve|process)_\w+|up|ALERTS)\b(?:\{([^}]*)\})?", expression)
    matchers = [
        (name, re.findall(r'(\w+)\s*(=~|!~|!=|=)\s*"([^"]*)"', braces)) for name, braces in selectors
    ]
    groupings = re.findall(r"\b(?:by|on)\s*\(([^)]*)\)", expression)
    grouped_by = {label.strip() for labels in groupings for label in labels.split(",")} - {""}
    return matchers, grouped_by


def check_expression(expression, scraped):
    """Asserts that the server exports every metric, label and label value of an expression."""
    metrics, grouped_by = names_and_labels(expression)
    known = set(SCRAPE_LABELS)
    for name, matchers in metrics:
        if name in OF_PROMETHEUS | OF_BUDGETS:
            known |= (OF_PROMETHEUS | OF_BUDGETS)[name]
            continue
        assert name in scraped, f"{name} is not exported"
        known.update(*scraped[name])
        for label, operator, pattern in matchers:
            if label in SCRAPE_LABELS:
                continue
            values = {labels.get(label) for labels in scraped[name]}
            assert None not in values, f"{name} has no label {label}"
            if operator == "=~":
                for alternative in pattern.split("|"):
                    if alternative not in ABSENT:
                        assert any(re.fullmatch(alternative, value) for value in values), (
                            f'{name} has no {label}="{alternative}"'
                        )
            elif operator == "=":
                assert pattern in values, f'{name} has no {label}="{pattern}"'
    assert grouped_by <= known, f"no metric has {grouped_by - known}"


@pytest.mark.parametrize(("title", "target"), TARGETS)
def test_what_a_panel_reads_is_exported(title, target, scraped, server):
    expression = fill_in(target["expr"], server.http)
    assert names_and_labels(expression)[0], f"{title} reads no metric"
    check_expression(expression, scraped)


@pytest.mark.parametrize(("title", "target"), TARGETS)
def test_a_panel_shows_data(title, target, prometheus, server):
    series = prometheus.query(fill_in(target["expr"], server.http))
    assert series, f"{title} is empty"
    for labels, value in series:
        assert math.isfinite(value), f"{title} shows {value}"
        for label in re.findall(r"\{\{(\w+)\}\}", target["legendFormat"]):
            # A policy file need not name the elements of its observations.
            assert labels.get(label) or label == "name", f"{title} has no {label} for its legend"


@pytest.mark.parametrize("annotation", DASHBOARD["annotations"]["list"], ids=lambda annotation: annotation["name"])
def test_an_annotation_reads_what_is_exported(annotation, scraped, prometheus, server):
    expression = fill_in(annotation["expr"], server.http)
    check_expression(expression, scraped)
    labels = set(re.findall(r"\{\{(\w+)\}\}", annotation["titleFormat"] + annotation["textFormat"]))
    assert labels <= names_and_labels(expression)[1]
    series = prometheus.query(expression)  # fails unless Prometheus can parse it
    if annotation.get("useValueForTime"):  # the roll-out of these tests has ended just now
        assert series
        assert all(abs(value / 1000 - time.time()) < 3600 for _, value in series)


def test_a_servers_link_leads_to_its_status_page(prometheus):
    linked = [panel for panel in PANELS if "links" in panel["fieldConfig"]["defaults"]]
    of_servers = [panel for panel in PANELS if any("{{instance}}" in target["legendFormat"] for target in panel["targets"])]
    assert linked == of_servers
    for panel in linked:
        [link] = panel["fieldConfig"]["defaults"]["links"]
        for labels, _ in prometheus.query("spikeserve_sessions_limit"):
            address = link["url"].replace("${scheme}", "http").replace("${__field.labels.instance}", labels["instance"])
            assert "<title>" in get(address)


def test_the_first_row_says_when_something_is_wrong():
    """Every figure of the first row has colours, and those of alerts change at the thresholds of the alerts."""
    first = [panel for panel in PANELS if panel["gridPos"]["y"] == 1]
    assert {panel["type"] for panel in first} == {"stat"}
    red = {
        panel["title"]: [step["value"] for step in panel["fieldConfig"]["defaults"]["thresholds"]["steps"] if step["color"] == "red"]
        for panel in first
    }
    alerts = ALERTS_YML.read_text()
    for title, alert in (
        ("Calls that fail", "SpikeserveErrors"),
        ("Call of a decision, p99", "SpikeserveSlow"),
        ("Sessions of the limit", "SpikeserveSessionsNearLimit"),
    ):
        rule = alerts.split(f"alert: {alert}\n")[1].split("for:")[0]
        assert red[title] == [float(rule.rsplit("> ", 1)[1])]


def test_the_dashboard_can_be_imported():
    """Checks the requirements of the import in Grafana that can be checked without Grafana."""
    assert DASHBOARD["schemaVersion"] >= 36  # Grafana 9: data sources by type and uid
    assert DASHBOARD["uid"]
    assert DASHBOARD["title"]
    assert "__inputs" not in DASHBOARD  # only dashboards that ask for a data source have inputs
    ids = [panel["id"] for panel in DASHBOARD["panels"]]
    assert len(set(ids)) == len(ids)
    taken = set()
    for panel in DASHBOARD["panels"]:
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24
        for x in range(place["x"], place["x"] + place["w"]):
            for y in range(place["y"], place["y"] + place["h"]):
                assert (x, y) not in taken, f"{panel['title']} overlaps another panel"
                taken.add((x, y))
    source = {"type": "prometheus", "uid": "${datasource}"}
    for panel in PANELS:
        assert panel["datasource"] == source
        assert len({target["refId"] for target in panel["targets"]}) == len(panel["targets"])
        assert all(target["datasource"] == source for target in panel["targets"])


def test_energy_models_stay_apart():
    panels = [panel for panel in PANELS if "energy_joules" in json.dumps(panel)]
    assert panels
    for panel in panels:
        assert panel["title"].startswith("Estimated")
        assert "stacking" not in panel["fieldConfig"]["defaults"]["custom"]
        for target in panel["targets"]:
            assert "energy_model" in names_and_labels(target["expr"])[1]
            assert "{{energy_model}}" in target["legendFormat"]


def test_the_variables_have_values(scraped):
    variables = {variable["name"]: variable for variable in DASHBOARD["templating"]["list"]}
    assert list(variables) == ["datasource", "policy", "version", "instance", "scheme"]
    for name in ("policy", "version", "instance"):
        query = variables[name]["query"]["query"]
        metric, label = re.fullmatch(r"label_values\((\w+)(?:\{.*\})?, (\w+)\)", query).groups()
        assert metric in scraped
        assert label in SCRAPE_LABELS or all(label in labels for labels in scraped[metric])


def test_what_an_alert_reads_is_exported(prometheus, scraped):
    rules = prometheus.rules()
    assert len(rules) >= 7
    for rule in rules:
        # Only a server with TLS exports these; test_tls.py reads them there.
        if "spikeserve_tls_expiry_timestamp_seconds" not in rule["query"]:
            check_expression(re.sub(r"\w+:\w+:\w+", "", rule["query"]), scraped)
        if rule["type"] == "alerting":
            assert rule["annotations"]["summary"]
            assert rule["annotations"]["runbook"]
    recorded = {rule["name"] for rule in rules if rule["type"] == "recording"}
    read = {name for rule in rules for name in re.findall(r"\b\w+:\w+:\w+", rule["query"])}
    assert read == recorded


def test_every_alert_is_explained_and_tested(prometheus):
    alerts = page_of("alerts.md").read_text()
    tests = (DEPLOY / "prometheus" / "alerts_test.yml").read_text()
    for rule in prometheus.rules():
        if rule["type"] == "alerting":
            assert f"`{rule['name']}`" in alerts
            assert f'alertname="{rule["name"]}"' in tests
    page = page_of("watching.md").read_text()
    for panel in PANELS:
        assert panel["title"] in page, f"docs/guides/watching.md does not describe panel {panel['title']}"


def test_the_server_is_up(prometheus):
    assert [value for _, value in prometheus.query('up{job="spikeserve"}')] == [1.0]


@pytest.mark.parametrize(
    "arguments",
    [
        ("check", "config", PROMETHEUS_YML),
        ("check", "rules", ALERTS_YML),
        ("test", "rules", DEPLOY / "prometheus" / "alerts_test.yml"),
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)
def test_promtool_is_content(arguments):
    run("promtool", *arguments)


needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd is not installed"
)


def systemd_analyze(tmp_path, *arguments):
    """Runs systemd-analyze on the unit, with values for the placeholders that CMake fills in."""
    program = pathlib.Path(os.environ["SPIKESERVE_PROGRAM"])
    text = UNIT.read_text().replace("@SPIKESERVE_BINDIR@", str(program.parent))
    text = text.replace("@SPIKESERVE_DATADIR@", "/usr/share/spikeserve")
    # A user that exists, because systemd-analyze checks that.
    text = text.replace("User=spikeserve", "User=daemon").replace("Group=spikeserve", "Group=daemon")
    unit = tmp_path / "spikeserve.service"
    unit.write_text(text)
    return run("systemd-analyze", *arguments, unit, status=None)


@needs_systemd
def test_systemd_is_content(tmp_path):
    finished = systemd_analyze(tmp_path, "verify")
    assert finished.returncode == 0, finished.stdout + finished.stderr
    assert finished.stderr == ""


@needs_systemd
def test_the_service_may_do_little(tmp_path):
    # Fails if the exposure exceeds the threshold, in tenths.
    finished = systemd_analyze(tmp_path, "security", "--offline=true", "--threshold=20")
    assert finished.returncode == 0, finished.stdout + finished.stderr
    for limit in ("MemoryMax", "TasksMax", "LogRateLimitBurst"):
        assert f"\n{limit}=" in UNIT.read_text()


def test_systemd_waits_for_the_drain():
    unit = UNIT.read_text()
    [drain] = re.findall(r"^Environment=SPIKESERVE_DRAIN_TIMEOUT=(\d+)s$", unit, re.MULTILINE)
    [stop] = re.findall(r"^TimeoutStopSec=(\d+)s$", unit, re.MULTILINE)
    assert int(drain) < int(stop)
