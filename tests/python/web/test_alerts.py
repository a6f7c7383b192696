"""Compares the alerts of the status page with those of deploy/prometheus.

promtool runs deploy/prometheus/alerts_test.yml with alerts.yml (test_watching.py). Here the server's own rules get the
same figures and must fire at the same times.
"""

import collections
import json
import re

import pytest
import yaml

from serving import DEPLOY, run

# Everything is text for this loader; to others, 0x20 (twenty-one zeros) is a hexadecimal number.
TESTS = yaml.load((DEPLOY / "prometheus/alerts_test.yml").read_text(), Loader=yaml.BaseLoader)["tests"]
# Prometheus itself observes whether a server can be scraped; the page, whether it answers.
NOT_IN_THE_SERVER = "SpikeserveDown"
PROMETHEUS_LABELS = {"job", "instance", "alertname", "alertstate", "severity", "__name__"}


def seconds(text):
    units = {"s": 1, "m": 60, "h": 3600, "d": 86400}
    return sum(int(number) * units[unit] for number, unit in re.findall(r"(\d+)([smhd])", text))


def parse_labels(text):
    return dict(re.findall(r'(\w+)="([^"]*)"', text))


def parse_values(text):
    """Returns the samples of promtool's notation: "0+2x3" is 0 2 4 6, "_x2" is nothing, twice."""
    samples = []
    for part in text.split():
        if missing := re.fullmatch(r"_(?:x(\d+))?", part):
            samples += [None] * int(missing[1] or 1)
            continue
        start, step, times = re.fullmatch(r"(-?[\d.]+)([+-][\d.]+)?(?:x(\d+))?", part).groups()
        samples += [float(start) + i * float(step or 0) for i in range(int(times or 0) + 1)]
    return samples


def series_by_instance(test):
    """Returns, for each server of a test, the samples by (name, labels)."""
    servers = collections.defaultdict(dict)
    for series in test["input_series"]:
        name = re.match(r"\w+", series["series"])[0]
        labels = parse_labels(series["series"])
        key = tuple(sorted((label, value) for label, value in labels.items() if label not in PROMETHEUS_LABELS))
        if labels["job"] == "spikeserve" and name != "up":
            servers[labels["instance"]][name, key] = parse_values(series["values"])
    return servers


def metrics_at(samples, index):
    """Returns the metrics at one sample, as /status.json has them."""
    metrics = collections.defaultdict(list)
    histograms = collections.defaultdict(list)
    for (name, key), values in samples.items():
        labels = dict(key)
        if index >= len(values) or values[index] is None:
            continue
        if name.endswith("_bucket"):
            bound = labels.pop("le")
            histograms[name.removesuffix("_bucket"), tuple(labels.items())].append(
                [None if bound == "+Inf" else float(bound), int(values[index])]
            )
        elif name.endswith("_count"):
            histograms[name.removesuffix("_count"), key].append([None, int(values[index])])
        else:
            metrics[name].append({"labels": labels, "value": values[index]})
    for (name, key), buckets in histograms.items():
        buckets.sort(key=lambda bucket: float("inf") if bucket[0] is None else bucket[0])
        metrics[name].append({"labels": dict(key), "buckets": buckets})
    return metrics


def replay(samples, interval, end):
    """Returns the alerts of the page at each minute up to `end`, in seconds."""
    ticks = [
        {"time": time, "metrics": metrics_at(samples, int(time // interval))} for time in range(0, end + 1, 60)
    ]
    answer = run("alert_replay", input=json.dumps({"ticks": ticks}))
    return [json.loads(line) for line in answer.stdout.splitlines()]


def firing(alerts):
    return {
        (alert["name"], tuple(sorted(instance["labels"].items())))
        for alert in alerts
        for instance in alert["instances"]
        if instance["state"] == "firing"
    }


def expected_alerts(expectation, instance):
    expected = set()
    for sample in expectation["exp_samples"]:
        labels = parse_labels(sample["labels"])
        if labels["alertname"] == NOT_IN_THE_SERVER or labels.get("instance", instance) != instance:
            continue
        others = {label: value for label, value in labels.items() if label not in PROMETHEUS_LABELS}
        expected.add((labels["alertname"], tuple(sorted(others.items()))))
    return expected


@pytest.mark.parametrize("test", TESTS, ids=lambda test: test["name"])
def test_the_page_fires_when_prometheus_does(test):
    end = max(seconds(expectation["eval_time"]) for expectation in test["promql_expr_test"])
    for instance, samples in series_by_instance(test).items():
        alerts = replay(samples, seconds(test["interval"]), end)
        for expectation in test["promql_expr_test"]:
            time = expectation["eval_time"]
            at = alerts[seconds(time) // 60]
            assert firing(at) == expected_alerts(expectation, instance), f"{instance} after {time}"


def test_the_page_has_every_alert_of_prometheus():
    [alerts] = replay({}, 60, 0)
    groups = yaml.safe_load((DEPLOY / "prometheus/alerts.yml").read_text())["groups"]
    rules = [rule for rule in groups[0]["rules"] if "alert" in rule]
    expected = [
        (rule["alert"], rule["labels"]["severity"], rule["annotations"]["description"], seconds(rule.get("for", "0s")))
        for rule in rules
    ]
    received = [(alert["name"], alert["severity"], alert["description"], alert["for_seconds"]) for alert in alerts]
    assert received == expected
