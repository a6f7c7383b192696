"""What the tests of the Helm chart share: its files, values that it takes and refuses, and what helm made of them.

The folder `rendered` has what `helm template` prints for the default values and for each example, so that tests without
helm see the same objects. After a change of the chart, make them again: `python3 -m tests.kubernetes.chart HELM`.
"""

import copy
import hashlib
import json
import pathlib
import subprocess
import sys

import yaml

ROOT = pathlib.Path(__file__).parents[2]
HELM_FOLDER = ROOT / "deploy/helm"
CHART = HELM_FOLDER / "spikeserve"
RENDERED = pathlib.Path(__file__).parent / "rendered"
EXAMPLES = {path.stem: path for path in sorted((HELM_FOLDER / "examples").glob("*.yaml"))}
CASES = ["default", *EXAMPLES]
SCHEMA = json.loads((CHART / "values.schema.json").read_text())
DEFAULTS = yaml.safe_load((CHART / "values.yaml").read_text())
KUBERNETES = "1.34.0"

# A setting, as values, and the field that the refusal names.
REFUSED = [
    ({"replica": 3}, "replica"),
    ({"replicas": "3"}, "replicas"),
    ({"replicas": 3}, "replicas"),  # of a store that they do not share
    ({"image": {"pullPolicy": "Sometimes"}}, "image.pullPolicy"),
    ({"sessions": {"store": "disk"}}, "sessions.store"),
    ({"sessions": {"store": "redis"}}, "redis.address"),
    ({"sessions": {"ttl": "10 minutes"}}, "sessions.ttl"),
    ({"sessions": {"durability": "always"}}, "sessions.durability"),
    ({"redis": {"address": "redis://redis:6379"}}, "redis.address"),
    ({"sessions": {"store": "redis"}, "redis": {"address": "redis://robot:secret@redis"}}, "redis.address"),
    ({"sessions": {"store": "redis"}, "redis": {"address": "http://redis"}}, "redis.address"),
    ({"file": {"size": "much"}}, "file.size"),
    ({"signing": {"secret": "keys"}}, "policies.claim"),
    ({"insecureNetwork": True, "tls": {"secret": "", "clientCertificates": True}}, "tls.secret"),
    ({"tls": {"probeName": "no name"}}, "tls.probeName"),
    ({"tls": {"secret": ""}}, "tls.secret"),
    ({"tokens": {"secret": ""}}, "tokens.secret"),
    ({"pod": {"user": 0}}, "pod.user"),
    ({"drain": {"noticeSeconds": 0}}, "drain.noticeSeconds"),
    ({"drain": {"timeoutSeconds": "30s"}}, "drain.timeoutSeconds"),
    ({"datagrams": {"hostPort": 70000}}, "datagrams.hostPort"),
    ({"maxConnectionAge": "never"}, "maxConnectionAge"),
    ({"flags": {"max_streems": 5}}, "flags.max_streems"),
    ({"flags": {"listen": "0.0.0.0:1"}}, "flags.listen"),  # a value of its own
    ({"extraEnv": [{"name": "SPIKESERVE_LISTEN", "value": "x"}]}, "extraEnv.0.name"),
    ({"resources": {"limits": {"memory": "1 GB"}}}, "resources.limits.memory"),
    ({"service": {"type": "Ingress"}}, "service.type"),
    ({"podDisruptionBudget": {"maxUnavailable": 0}}, "podDisruptionBudget.maxUnavailable"),
    ({"autoscaling": {"enabled": True}}, "autoscaling.enabled"),
    ({"networkPolicy": {"agents": [{"pods": {}}]}}, "networkPolicy.agents.0"),
    ({"networkPolicy": {"redisPorts": [66379]}}, "networkPolicy.redisPorts.0"),
    ({"serviceMonitor": {"enabled": True}, "tokens": {"secret": "tokens"}}, "serviceMonitor.tokenSecret"),
    ({"pod": {"tolerations": [{"effect": "Never"}]}}, "pod.tolerations.0.effect"),
]


def merged(values, others):
    """Returns `values` with `others`, as helm merges them."""
    result = copy.deepcopy(values)
    for key, value in others.items():
        both = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = merged(result[key], value) if both else value
    return result


def values_of(case):
    return {} if case == "default" else yaml.safe_load(EXAMPLES[case].read_text())


def source_digest():
    """Returns a hash of what decides the rendered objects, except the alerts and the dashboard."""
    digest = hashlib.sha256()
    files = [path for path in CHART.rglob("*") if path.is_file() and path.parent.name != "files"]
    for path in sorted([*files, *EXAMPLES.values()]):
        digest.update(f"{path.relative_to(HELM_FOLDER)}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def render(helm, case, chart=CHART):
    """Returns the objects that helm makes of the values of `case`."""
    values = [] if case == "default" else ["--values", EXAMPLES[case]]
    command = [helm, "template", "spikeserve", chart, "--namespace", "robots", "--kube-version", KUBERNETES, *values]
    finished = subprocess.run([*map(str, command)], capture_output=True, text=True)
    assert finished.returncode == 0, finished.stderr
    return list(filter(None, yaml.safe_load_all(finished.stdout)))


def is_kept(document):
    """Returns whether an object is part of the rendered files: the alerts and the dashboard are files of their own."""
    return document["kind"] not in ("PrometheusRule", "ConfigMap")


def name_of(document):
    return f"{document['kind']}/{document['metadata']['name']}"


def rendered(case):
    """Returns the objects of the rendered file of `case`. Those that are as in the default case have only their name there."""
    documents = list(yaml.safe_load_all((RENDERED / f"{case}.yaml").read_text()))
    default = {} if case == "default" else {name_of(document): document for document in rendered("default")}
    return [default[document] if isinstance(document, str) else document for document in documents]


def find(documents, kind):
    [document] = [document for document in documents if document["kind"] == kind]
    return document


def workload(documents):
    [document] = [document for document in documents if document["kind"] in ("Deployment", "StatefulSet")]
    return document


def write_rendered(helm):
    RENDERED.mkdir(exist_ok=True)
    default = list(filter(is_kept, render(helm, "default")))
    for case in CASES:
        documents = filter(is_kept, render(helm, case))
        if case != "default":
            documents = (name_of(document) if document in default else document for document in documents)
        text = yaml.safe_dump_all(documents, sort_keys=False, width=118, default_flow_style=None)
        (RENDERED / f"{case}.yaml").write_text(text)
    (RENDERED / "source.sha256").write_text(source_digest() + "\n")


if __name__ == "__main__":
    write_rendered(sys.argv[1])
