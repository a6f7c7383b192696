"""The Helm chart with helm: lint, the objects of all examples, refusals, and an installation in a real API server.

Needs helm and kube-apiserver, which `deploy/setup.sh build chart` builds, and etcd; is skipped without them.
"""

import pathlib
import re
import shutil
import subprocess
import sys

import pytest
import yaml

ROOT = pathlib.Path(__file__).parents[3]
sys.path.insert(0, str(ROOT))

from serving import DEPLOY  # noqa: E402

from tests.kubernetes.chart import (  # noqa: E402
    CASES,
    CHART,
    EXAMPLES,
    REFUSED,
    find,
    is_kept,
    render,
    rendered,
    workload,
)
from tests.kubernetes.cluster import running_cluster  # noqa: E402

HELM = ROOT / "build/kubernetes/bin/helm"
APISERVER = ROOT / "build/kubernetes/bin/kube-apiserver"
IDS = [f"{field}-{i}" for i, (_, field) in enumerate(REFUSED)]

pytestmark = pytest.mark.skipif(not HELM.exists(), reason="without helm, which `deploy/setup.sh build chart` builds")


def helm(*arguments, **options):
    return subprocess.run([*map(str, (HELM, *arguments))], capture_output=True, text=True, **options)


def names_field(text, field):
    """Returns whether an error is about a field: helm names it by a JSON pointer, an unknown one by that of its object."""
    known, _, name = field.rpartition(".")
    places = [
        "/" + field.replace(".", "/"),
        f"at '{known and '/' + known}': additional properties '{name}' not allowed",
    ]
    return any(place in text for place in places)


@pytest.mark.parametrize("case", CASES)
def test_lint_is_content(case):
    values = [] if case == "default" else ["--values", EXAMPLES[case]]
    finished = helm("lint", "--strict", CHART, *values)
    assert finished.returncode == 0, finished.stdout + finished.stderr


@pytest.mark.parametrize("case", CASES)
def test_helm_makes_the_objects_that_the_other_tests_read(case):
    assert [document for document in render(HELM, case) if is_kept(document)] == rendered(case)


def test_the_rules_and_the_dashboard_are_the_files_of_deploy():
    documents = render(HELM, "autoscaled")
    alerts = yaml.safe_load((DEPLOY / "prometheus/alerts.yml").read_text())
    assert find(documents, "PrometheusRule")["spec"] == alerts
    dashboard = find(documents, "ConfigMap")["data"]["spikeserve.json"]
    assert dashboard == (DEPLOY / "grafana/spikeserve.json").read_text()


@pytest.mark.parametrize(("values", "field"), REFUSED, ids=IDS)
def test_helm_refuses_by_the_name_of_the_field(values, field, tmp_path):
    (tmp_path / "values.yaml").write_text(yaml.safe_dump(values))
    finished = helm("template", "spikeserve", CHART, "--kube-version", "1.34.0", "--values", tmp_path / "values.yaml")
    assert finished.returncode != 0
    assert names_field(finished.stderr, field), finished.stderr


def test_helm_refuses_a_range_that_is_empty():
    finished = helm(
        *("template", "spikeserve", CHART, "--kube-version", "1.34.0", "--values", EXAMPLES["autoscaled"]),
        *("--set", "autoscaling.minReplicas=13"),
    )
    assert finished.returncode != 0
    assert "autoscaling.minReplicas: expected at most autoscaling.maxReplicas, 12, received 13" in finished.stderr


def test_the_test_is_pulled_and_placed_as_the_server():
    settings = "image.pullSecrets={registry},pod.priorityClassName=robots,pod.nodeSelector.arm=left,pod.tolerations[0].key=arm"
    finished = helm("template", "spikeserve", CHART, "--kube-version", "1.34.0", "--set", settings)
    assert finished.returncode == 0, finished.stderr
    documents = list(filter(None, yaml.safe_load_all(finished.stdout)))
    pod, test = workload(documents)["spec"]["template"]["spec"], find(documents, "Pod")["spec"]
    for field in ("imagePullSecrets", "priorityClassName", "nodeSelector", "tolerations"):
        assert pod[field]
        assert test[field] == pod[field]


def test_a_package_of_the_chart_makes_the_same_objects(tmp_path):
    """The alerts and the dashboard, which are links in the checkout, are files in the package."""
    assert helm("package", CHART, "--destination", tmp_path).returncode == 0
    [package] = tmp_path.glob("*.tgz")
    assert render(HELM, "autoscaled", package) == render(HELM, "autoscaled")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    if not APISERVER.exists() or shutil.which("etcd") is None:
        pytest.skip("without kube-apiserver or etcd")
    with running_cluster(APISERVER, tmp_path_factory.mktemp("cluster")) as running:
        running.define("monitoring.coreos.com", "ServiceMonitor", "servicemonitors")
        running.define("monitoring.coreos.com", "PrometheusRule", "prometheusrules")
        yield running


def release(cluster, *arguments):
    return helm(*arguments, "--kubeconfig", cluster.kubeconfig)


def deployed(cluster, namespace, plural="deployments", name="spikeserve"):
    status, answer = cluster.call(f"/apis/apps/v1/namespaces/{namespace}/{plural}/{name}")
    assert status == 200, answer
    return answer


@pytest.mark.parametrize("case", CASES)
def test_the_api_server_takes_every_example(cluster, case):
    values = [] if case == "default" else ["--values", EXAMPLES[case]]
    finished = release(cluster, "install", "spikeserve", CHART, "--namespace", case, "--create-namespace", *values)
    assert finished.returncode == 0, finished.stderr
    assert "unknown field" not in finished.stderr
    assert "spikeserve serves at" in finished.stdout
    finished = release(cluster, "uninstall", "spikeserve", "--namespace", case)
    assert finished.returncode == 0, finished.stderr


def test_install_upgrade_and_roll_back(cluster):
    flags = ["--namespace", "fleet", "--values", EXAMPLES["redis"]]
    assert release(cluster, "install", "spikeserve", CHART, "--create-namespace", *flags).returncode == 0
    assert deployed(cluster, "fleet")["spec"]["replicas"] == 3
    finished = release(
        cluster, "upgrade", "spikeserve", CHART, *flags, "--set", "replicas=5", "--set", "image.tag=0.2.0"
    )
    assert finished.returncode == 0, finished.stderr
    changed = deployed(cluster, "fleet")["spec"]
    assert changed["replicas"] == 5
    assert changed["template"]["spec"]["containers"][0]["image"] == "spikeserve:0.2.0"
    refused = release(cluster, "upgrade", "spikeserve", CHART, *flags, "--set", "replicas=many")
    assert refused.returncode != 0
    assert names_field(refused.stderr, "replicas"), refused.stderr
    assert deployed(cluster, "fleet")["spec"] == changed
    assert release(cluster, "rollback", "spikeserve", "1", "--namespace", "fleet").returncode == 0
    assert deployed(cluster, "fleet")["spec"]["replicas"] == 3


def test_the_stateful_set_can_be_upgraded(cluster):
    flags = ["--namespace", "robot"]
    assert release(cluster, "install", "spikeserve", CHART, "--create-namespace", *flags).returncode == 0
    finished = release(
        cluster, "upgrade", "spikeserve", CHART, *flags, "--set", "image.tag=0.2.0", "--set", "sessions.ttl=1h"
    )
    assert finished.returncode == 0, finished.stderr
    [container] = deployed(cluster, "robot", "statefulsets")["spec"]["template"]["spec"]["containers"]
    assert {"name": "SPIKESERVE_SESSION_TTL", "value": "1h"} in container["env"]


def test_a_value_that_only_the_api_server_knows_is_refused_by_its_field(cluster):
    finished = release(
        *(
            cluster,
            "install",
            "spikeserve",
            CHART,
            "--namespace",
            "default",
            "--set",
            "pod.labels.robot=no/label/at/all",
        ),
    )
    assert finished.returncode != 0
    assert re.search(r"spec\.template\.(metadata\.)?labels", finished.stderr), finished.stderr
