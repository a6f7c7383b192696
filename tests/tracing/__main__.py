"""Shows one decision, from an agent in Python through a balancer to the append in Redis, as a collector receives it.

usage: python -m tests.tracing

Starts Redis, two servers that share it, nginx in front of them, a collector, and an agent whose spans OpenTelemetry's
own SDK sends to the collector. The agent plays on a SYNC session, and goes on after the server that owns it was killed.
Needs the variables SPIKESERVE_PROGRAM and SPIKESERVE_INTEROP, redis-server, nginx and the package of the Python client.
"""

import contextlib
import os
import pathlib
import sys
import tempfile

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests/python"), str(ROOT / "tests/python/client")]

import grpc  # noqa: E402
import spikeserve  # noqa: E402
from opentelemetry.sdk.resources import Resource  # noqa: E402
from opentelemetry.sdk.trace import TracerProvider  # noqa: E402
from opentelemetry.sdk.trace.export import SimpleSpanProcessor, SpanExporter, SpanExportResult  # noqa: E402
from redis_servers import free_port  # noqa: E402
from replicated import running_fleet  # noqa: E402
from security import make_authority, make_certificate, until  # noqa: E402
from test_proxied_replicas import in_front  # noqa: E402
from traces import Span, collecting, environment  # noqa: E402

SHOWN = ("db.system.name", "rpc.response.status_code", "spikeserve.policy", "spikeserve.policy.version")
SHOWN += ("spikeserve.step", "spikeserve.spikes", "spikeserve.energy_joules")


class ToCollector(SpanExporter):
    """Hands the spans of this process to the collector, which lives in it."""

    def __init__(self, collector):
        self._collector = collector

    def export(self, spans):
        for span in spans:
            context, parent = span.get_span_context(), span.parent
            self._collector.add(
                Span(
                    name=span.name,
                    kind=span.kind.name,
                    trace=f"{context.trace_id:032x}",
                    id=f"{context.span_id:016x}",
                    parent=f"{parent.span_id:016x}" if parent else "",
                    begin=span.start_time,
                    end=span.end_time,
                    attributes=dict(span.attributes),
                    error=None,
                    process=dict(span.resource.attributes),
                )
            )
        return SpanExportResult.SUCCESS


def show(spans, parent="", depth=0, origin=None):
    """Prints the spans below `parent`, each with its begin and its length in milliseconds."""
    for span in sorted((span for span in spans if span.parent == parent), key=lambda span: span.begin):
        begin = origin or span.begin
        figures = f"{(span.begin - begin) / 1e6:8.2f} {(span.end - span.begin) / 1e6:8.2f}"
        facts = " ".join(
            f"{key.rpartition('spikeserve.')[2]}={span.attributes[key]:.3g}"
            if isinstance(span.attributes[key], float)
            else f"{key.rpartition('spikeserve.')[2]}={span.attributes[key]}"
            for key in SHOWN
            if key in span.attributes
        )
        name = "  " * depth + span.name.rpartition(".")[2]
        process = span.process["service.name"]
        print(f"{name:34} {process:10} {figures}  {facts}".rstrip())
        show(spans, span.id, depth + 1, begin)


@contextlib.contextmanager
def balanced(fleet, path):
    """Starts nginx in front of the servers and yields its address and the credentials for it."""
    make_authority(path, "ca")
    make_certificate(path, "server", "ca")
    port = free_port()
    with in_front("nginx", path, port, path, fleet.replicas):
        yield f"localhost:{port}", grpc.ssl_channel_credentials((path / "ca.pem").read_bytes())


def is_ready(address, credentials):
    with spikeserve.Client(address, credentials=credentials) as client:
        with contextlib.suppress(spikeserve.SpikeserveError):
            return client.list_policies()


def trace_of(tracer, collector, name, act, awaited):
    """Calls `act` in a span. Returns the spans of its trace when that has the span `awaited`."""
    with tracer.start_as_current_span(name) as span:
        act()
    trace = f"{span.get_span_context().trace_id:032x}"
    collector.find(awaited, trace=trace)
    call = collector.find("spikeserve.v1.PolicyService/Act", trace=trace, rpc_response_status_code="OK")
    collector.find("append", parent=call.id)
    return [span for span in list(collector.spans) if span.trace == trace]


def main():
    with contextlib.ExitStack() as stack:
        path = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        collector = stack.enter_context(collecting())
        os.environ |= environment(collector.port)
        fleet = stack.enter_context(running_fleet(replicas=2))
        address, credentials = stack.enter_context(balanced(fleet, path))
        until(lambda: is_ready(address, credentials))

        provider = TracerProvider(resource=Resource({"service.name": "agent"}))
        provider.add_span_processor(SimpleSpanProcessor(ToCollector(collector)))
        tracer = provider.get_tracer("agent")

        client = stack.enter_context(spikeserve.Client(address, credentials=credentials))
        session = client.open_session("cartpole", spikeserve.SessionOptions(durability="SYNC"))
        print(f"{'span':34} {'process':10} {'begin':>8} {'ms':>8}  attributes\n")
        show(trace_of(tracer, collector, "think", lambda: session.act([0.0, 0.1, 0.0, -0.1]), "append"))

        owner = collector.find("append").process["process.pid"]
        next(replica for replica in fleet.replicas if replica.pid == owner).kill()
        print("\nThe server that owned the session was killed:\n")
        show(trace_of(tracer, collector, "think on", lambda: session.act([0.0, 0.2, 0.0, -0.2], 1.0), "claim"))


if __name__ == "__main__":
    main()
