"""The Helm chart without helm: its values and their schema, its flags, and the objects that helm made of the examples.

test_helm.py, of `make test-slow`, makes the same objects anew.
"""

import json
import os
import pathlib
import re
import sys

import grpc
import jsonschema
import pytest
import yaml

ROOT = pathlib.Path(__file__).parents[3]
sys.path.insert(0, str(ROOT))

from security import ADMIN, HEALTH, TOKENS, Bearer, code_of, credentials  # noqa: E402
from serving import DEPLOY, SHIPPED_POLICIES, Service, run, running_server  # noqa: E402

from tests.kubernetes.chart import (  # noqa: E402
    CASES,
    CHART,
    DEFAULTS,
    HELM_FOLDER,
    REFUSED,
    RENDERED,
    SCHEMA,
    find,
    merged,
    rendered,
    source_digest,
    values_of,
    workload,
)

KUBERNETES_VALIDATE = ROOT / "build/release-tools/venv/bin/kubernetes-validate"
VALIDATOR = jsonschema.Draft7Validator(SCHEMA)
TEMPLATES = "\n".join(path.read_text() for path in CHART.rglob("templates/**/*") if path.is_file())
# Beyond --drain_timeout a server needs time to tell its clients, to write to its store, and to leave (server/server.cc).
LEAVING_SECONDS = 5


def errors(values):
    """Returns the errors of the schema, by the field that they are about."""
    found = {}
    for error in VALIDATOR.iter_errors(merged(DEFAULTS, values)):
        path = list(error.absolute_path)
        if error.validator == "additionalProperties":
            path += re.findall(r"'([^']+)' was unexpected", error.message)
        found[".".join(map(str, path))] = error.message
    return found


@pytest.mark.parametrize("case", CASES)
def test_the_schema_takes_the_examples(case):
    jsonschema.Draft7Validator.check_schema(SCHEMA)
    assert errors(values_of(case)) == {}


@pytest.mark.parametrize(("values", "field"), REFUSED, ids=[f"{field}-{i}" for i, (_, field) in enumerate(REFUSED)])
def test_the_schema_refuses_by_the_name_of_the_field(values, field):
    assert any(name == field or name.startswith(field + ".") for name in errors(values)), errors(values)


def fields(values, prefix=""):
    for key, value in values.items():
        yield prefix + key
        if isinstance(value, dict):
            yield from fields(value, f"{prefix}{key}.")


def test_values_and_schema_have_the_same_fields():
    def of_schema(node, prefix=""):
        for key, value in node.get("properties", {}).items():
            yield prefix + key
            yield from of_schema(value, f"{prefix}{key}.")

    listed, described = set(fields(DEFAULTS)), set(of_schema(SCHEMA)) - {"global"}
    absent = {field for field in described - listed if field.rpartition(".")[0] not in listed}
    assert absent == set()
    for field in described - listed:  # fields of objects that are empty by default, such as resources.limits.cpu
        assert re.match(r"flags|resources|pod\.affinity", field), field
    for field in listed - described:  # names of the user's choice
        assert re.match(r"\w+\.labels\.", field), field


def test_the_schema_is_strict_everywhere():
    def check(node, path):
        if isinstance(node, dict):
            if node.get("type") == "object" and "properties" in node:
                assert node.get("additionalProperties") is False, path
            for key, value in node.items():
                check(value, f"{path}/{key}")

    check(SCHEMA, "")


def flags(program):
    """Returns the flags of a program, those included that --help only counts."""
    manual = run(program, "--generate=man").stdout
    return set(re.findall(r"--(\w+)", manual.replace("\\-", "-")))


def test_every_variable_is_a_flag_of_its_program():
    for program, known in (
        ("SPIKESERVE", flags(os.environ["SPIKESERVE_PROGRAM"])),
        ("SPIKECTL", flags(os.environ["SPIKECTL_PROGRAM"])),
    ):
        names = set(re.findall(rf"name: {program}_([A-Z_0-9]+)", TEMPLATES))
        assert names
        assert {name.lower() for name in names} <= known
    assert set(SCHEMA["properties"]["flags"]["properties"]) <= flags(os.environ["SPIKESERVE_PROGRAM"])


def test_the_chart_has_the_version_of_the_programs():
    chart = yaml.safe_load((CHART / "Chart.yaml").read_text())
    assert (chart["version"], chart["appVersion"]) == (os.environ["SPIKESERVE_VERSION"],) * 2


def test_the_alerts_and_the_dashboard_are_those_of_the_other_deployments():
    assert (CHART / "files/alerts.yml").read_bytes() == (DEPLOY / "prometheus/alerts.yml").read_bytes()
    assert (CHART / "files/dashboard.json").read_bytes() == (DEPLOY / "grafana/spikeserve.json").read_bytes()


def test_the_adapter_makes_the_metric_of_the_autoscaler():
    [rule] = yaml.safe_load((HELM_FOLDER / "prometheus-adapter.yaml").read_text())["rules"]["custom"]
    [metric] = find(rendered("autoscaled"), "HorizontalPodAutoscaler")["spec"]["metrics"]
    assert metric["pods"]["metric"]["name"] == rule["name"]["as"]
    metrics = (ROOT / "server/metrics/policy_metrics.cc").read_text() + (ROOT / "server/metrics/metrics.cc").read_text()
    assert rule["seriesQuery"].split("{")[0] in metrics


def test_the_rendered_files_are_those_of_the_chart():
    expected = (RENDERED / "source.sha256").read_text().strip()
    assert source_digest() == expected, "make them again: python3 -m tests.kubernetes.chart HELM"


@pytest.mark.skipif(not KUBERNETES_VALIDATE.exists(), reason="without kubernetes-validate")
@pytest.mark.parametrize("case", CASES)
def test_kubernetes_knows_every_field(case, tmp_path):
    """Strictly, by the schemas of Kubernetes itself. Those of the Prometheus Operator are not among them."""
    documents = [document for document in rendered(case) if "monitoring.coreos.com" not in document["apiVersion"]]
    objects = tmp_path / "objects.yaml"
    objects.write_text(yaml.safe_dump_all(documents))
    run(KUBERNETES_VALIDATE, "--strict", "--kubernetes-version", "1.34", objects)


def container(case):
    [only] = workload(rendered(case))["spec"]["template"]["spec"]["containers"]
    return only


def environment(case):
    """Returns the variables with this machine as the node."""
    given = {variable["name"]: variable.get("value", "127.0.0.1") for variable in container(case)["env"]}
    return {name: value.replace("$(NODE_IP)", given.get("NODE_IP", "")) for name, value in given.items()}


@pytest.mark.parametrize("case", CASES)
def test_a_pod_may_drain_before_it_is_killed(case):
    spec = workload(rendered(case))["spec"]["template"]["spec"]
    notice = container(case)["lifecycle"]["preStop"]["sleep"]["seconds"]
    drain = int(environment(case)["SPIKESERVE_DRAIN_TIMEOUT"].removesuffix("s"))
    assert notice > 0
    assert spec["terminationGracePeriodSeconds"] >= notice + drain + LEAVING_SECONDS


@pytest.mark.parametrize("case", CASES)
def test_every_mount_has_its_volume_and_every_file_its_mount(case):
    state = workload(rendered(case))["spec"]
    volumes = {volume["name"] for volume in state["template"]["spec"].get("volumes", [])}
    volumes |= {claim["metadata"]["name"] for claim in state.get("volumeClaimTemplates", [])}
    mounts = {mount["name"]: mount["mountPath"] for mount in container(case).get("volumeMounts", [])}
    assert set(mounts) == volumes
    written = [
        value for name, value in environment(case).items() if re.search(r"/etc/spikeserve|/var/lib|^/policies", value)
    ]
    for value in written:
        assert any(f"{path}/" in f"{value}/" for path in mounts.values()), value


def test_only_the_file_store_has_an_identity():
    kinds = {case: workload(rendered(case))["kind"] for case in CASES}
    stores = {case: merged(DEFAULTS, values_of(case))["sessions"]["store"] for case in CASES}
    assert kinds == {case: "StatefulSet" if store == "file" else "Deployment" for case, store in stores.items()}
    headless = [s for s in rendered("default") if s["kind"] == "Service" and s["spec"].get("clusterIP") == "None"]
    assert workload(rendered("default"))["spec"]["serviceName"] == headless[0]["metadata"]["name"]


def test_the_autoscaler_alone_sets_the_replicas():
    assert "replicas" not in workload(rendered("autoscaled"))["spec"]
    target = find(rendered("autoscaled"), "HorizontalPodAutoscaler")["spec"]["scaleTargetRef"]
    deployed = workload(rendered("autoscaled"))
    assert (target["kind"], target["name"]) == (deployed["kind"], deployed["metadata"]["name"])


@pytest.mark.parametrize("case", CASES)
def test_the_selectors_find_the_pods(case):
    documents = rendered(case)
    labels = workload(documents)["spec"]["template"]["metadata"]["labels"].items()
    for document in documents:
        spec = document.get("spec", {})
        for selector in (
            spec.get("selector") if document["kind"] == "Service" else None,
            spec.get("selector", {}).get("matchLabels")
            if document["kind"] not in ("Service", "ServiceMonitor")
            else None,
            spec.get("podSelector", {}).get("matchLabels"),
        ):
            assert (selector or {}).items() <= labels, document["kind"]


class Pod:
    """The container of a case as processes of this machine. The folders that Kubernetes would mount are in `folder`."""

    def __init__(self, case, folder):
        self._folder = folder
        self._variables = {
            name: re.sub(r"(/etc/spikeserve|/var/lib/spikeserve)", rf"{folder}\1", value)
            for name, value in environment(case).items()
        }
        self._probe = container(case)["readinessProbe"]["exec"]["command"]

    def flags(self):
        """Returns the variables as flags, with free ports and this machine's policies."""
        here = {"SPIKESERVE_LISTEN": "127.0.0.1:0", "SPIKESERVE_HTTP_LISTEN": "127.0.0.1:0"}
        here["SPIKESERVE_POLICIES"] = str(SHIPPED_POLICIES)
        here |= {name: "127.0.0.1:0" for name in self._variables if name == "SPIKESERVE_DATAGRAM_LISTEN"}
        variables = self._variables | here
        return [
            f"--{name.removeprefix('SPIKESERVE_').lower()}={value}"
            for name, value in variables.items()
            if name.startswith("SPIKESERVE_")
        ]

    def probe(self, address):
        """Runs the readiness probe, and returns its exit status and what it printed."""
        variables = {name: value for name, value in self._variables.items() if name.startswith("SPIKECTL_")}
        host = variables["SPIKECTL_SERVER"].split(":")[0]
        assert host in ("127.0.0.1", "localhost")
        own = variables | {"SPIKECTL_SERVER": f"{host}:{address.split(':')[1]}"}
        finished = run("spikectl", *self._probe[1:], env=own, status=None)
        return finished.returncode, finished.stdout + finished.stderr


@pytest.fixture
def folder(tmp_path, certificates):
    """Returns a folder with the volume and the secrets that a pod mounts."""
    (tmp_path / "var/lib/spikeserve").mkdir(parents=True)
    secrets = tmp_path / "etc/spikeserve"
    for name in ("tls", "tokens"):
        (secrets / name).mkdir(parents=True)
    for here, there in (("server.pem", "tls.crt"), ("server.key", "tls.key"), ("ca.pem", "ca.crt")):
        (secrets / "tls" / there).write_bytes((certificates / here).read_bytes())
    (secrets / "tokens/tokens.json").write_text(json.dumps(TOKENS))
    return tmp_path


def test_the_default_pod_is_ready_and_a_drained_one_is_not(folder, certificates):
    pod = Pod("default", folder)
    with running_server(flags=pod.flags()) as addresses:
        assert pod.probe(addresses.grpc) == (0, "SERVING\n")
        target = f"localhost:{addresses.grpc.split(':')[1]}"
        with grpc.secure_channel(target, credentials(certificates)) as channel:
            assert code_of(Service(channel, ADMIN).Drain) == grpc.StatusCode.UNAUTHENTICATED
            Service(channel, ADMIN, grpc.intercept_channel(channel, Bearer("operator"))).Drain()
        status, text = pod.probe(addresses.grpc)
        assert status != 0
        assert "NOT_SERVING" in text
    assert {"sessions", "audit.jsonl"} <= {path.name for path in (folder / "var/lib/spikeserve").iterdir()}


def test_the_secure_pod_answers_its_probe_over_mutual_tls(folder, certificates):
    pod = Pod("secure", folder)
    with running_server(flags=pod.flags()) as addresses:
        assert pod.probe(addresses.grpc) == (0, "SERVING\n")
        without = credentials(certificates)
        target = f"localhost:{addresses.grpc.split(':')[1]}"
        with grpc.secure_channel(target, without) as channel, pytest.raises(grpc.RpcError):
            Service(channel, HEALTH).Check()


@pytest.mark.parametrize("case", CASES)
def test_nothing_is_open_as_printed(case):
    """Everyone who reaches a port needs TLS and a token, and the NetworkPolicy says who does."""
    variables = environment(case)
    assert {"SPIKESERVE_TLS_CERTIFICATE", "SPIKESERVE_TOKENS"} <= set(variables)
    assert "SPIKESERVE_INSECURE_NETWORK" not in variables
    rules = find(rendered(case), "NetworkPolicy")["spec"]["ingress"]
    assert rules and all(rule["from"] for rule in rules)


def test_the_test_runs_where_the_server_does():
    pod, test = workload(rendered("memory"))["spec"]["template"]["spec"], find(rendered("memory"), "Pod")["spec"]
    for field in ("nodeSelector", "tolerations"):
        assert test[field] == pod[field]


def test_the_platform_may_choose_the_user():
    def users(case):
        contexts = [
            (document["spec"]["template"]["spec"] if document["kind"] == "StatefulSet" else document["spec"])["securityContext"]
            for document in rendered(case)
            if document["kind"] in ("StatefulSet", "Pod")
        ]
        assert len(contexts) == 2
        assert all(context["runAsNonRoot"] for context in contexts)
        return [{key: context.get(key) for key in ("runAsUser", "runAsGroup", "fsGroup")} for context in contexts]

    assert users("default") == [dict.fromkeys(("runAsUser", "runAsGroup", "fsGroup"), 10001)] * 2
    assert users("openshift") == [dict.fromkeys(("runAsUser", "runAsGroup", "fsGroup"))] * 2
