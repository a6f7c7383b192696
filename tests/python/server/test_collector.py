"""The spans of one decision, as the real collector of OpenTelemetry writes them down.

Needs the collector, which `deploy/setup.sh build collector` builds; is skipped without it.
"""

import contextlib
import pathlib
import re
import subprocess

import pytest
import spikeserve
from opentelemetry.sdk.trace import TracerProvider
from redis_servers import free_port
from security import until
from serving import running_server
from traces import environment

COLLECTOR = pathlib.Path(__file__).parents[3] / "build/collector/otelcol"
ACT = "spikeserve.v1.PolicyService/Act"
CONFIGURATION = """
receivers: {{otlp: {{protocols: {{grpc: {{endpoint: "127.0.0.1:{port}"}}}}}}}}
exporters: {{debug: {{verbosity: detailed, use_internal_logger: false}}}}
service:
  telemetry: {{metrics: {{level: none}}}}
  pipelines: {{traces: {{receivers: [otlp], exporters: [debug]}}}}
"""

pytestmark = pytest.mark.skipif(
    not COLLECTOR.exists(), reason="without the collector, which `deploy/setup.sh build collector` builds"
)


class Collector:
    """A running collector, and what it has written."""

    def __init__(self, port, output):
        self.port = port
        self._output = output

    def spans(self):
        """Returns the spans as dicts with what the exporter prints of each, and `attributes`."""
        return [self._parse(text) for text in re.split(r"^Span #\d+\n", self._output.read_text(), flags=re.M)[1:]]

    @staticmethod
    def _parse(text):
        span = dict(re.findall(r"^    (\w[\w ]*?) *: (.*)$", text, flags=re.M))
        span["attributes"] = dict(re.findall(r"^     -> ([\w.]+): \w+\((.*)\)$", text, flags=re.M))
        return span

    def find(self, name, parent):
        """Waits for the span `name` below the span `parent`."""
        [span] = until(lambda: [span for span in self.spans() if (span["Name"], span["Parent ID"]) == (name, parent)])
        return span


@pytest.fixture
def collector(tmp_path):
    port = free_port()
    configuration, output, log = (tmp_path / name for name in ("collector.yaml", "spans", "log"))
    configuration.write_text(CONFIGURATION.format(port=port))
    with contextlib.ExitStack() as stack:
        files = [stack.enter_context(path.open("w")) for path in (output, log)]
        process = subprocess.Popen([COLLECTOR, f"--config={configuration}"], stdout=files[0], stderr=files[1])
        stack.callback(process.wait)
        stack.callback(process.terminate)
        until(lambda: "Everything is ready" in log.read_text() or process.poll() is not None)
        assert process.poll() is None, log.read_text()
        yield Collector(port, output)


def test_one_decision_from_the_agent_to_the_store(collector, monkeypatch, tmp_path):
    for name, value in environment(collector.port).items():
        monkeypatch.setenv(name, value)
    tracer = TracerProvider().get_tracer("agent")
    store = f"--session_store=file:{tmp_path / 'store'}"
    with running_server(flags=[store]) as addresses, spikeserve.Client(addresses.grpc) as client:
        session = client.open_session("cartpole", spikeserve.SessionOptions(durability="SYNC"))
        with tracer.start_as_current_span("think") as think:
            decision = session.act([0.0, 0.1, 0.0, -0.1])
        context = think.get_span_context()
        call = collector.find(ACT, parent=f"{context.span_id:016x}")
        decide = collector.find("decide", parent=call["ID"])
        append = collector.find("append", parent=call["ID"])
    assert {span["Trace ID"] for span in (call, decide, append)} == {f"{context.trace_id:032x}"}
    assert [span["Kind"] for span in (call, decide, append)] == ["Server", "Internal", "Client"]
    assert call["attributes"]["rpc.response.status_code"] == "OK"
    assert decide["attributes"]["spikeserve.policy"] == "cartpole"
    assert int(decide["attributes"]["spikeserve.spikes"]) == decision.stats.spikes
    assert float(decide["attributes"]["spikeserve.energy_joules"]) == pytest.approx(decision.stats.energy_joules)
    assert append["attributes"]["db.system.name"] == "lmdb"
