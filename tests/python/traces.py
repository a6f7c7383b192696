"""A collector of traces: receives OTLP over gRPC by the public messages of OpenTelemetry."""

import concurrent.futures
import contextlib
import dataclasses
import threading

import grpc
from opentelemetry.proto.collector.trace.v1 import trace_service_pb2, trace_service_pb2_grpc
from opentelemetry.proto.trace.v1.trace_pb2 import Span as Proto

WAIT = 120  # seconds for what takes a moment


def value_of(any_value):
    return getattr(any_value, any_value.WhichOneof("value"))


def pairs(attributes):
    return {attribute.key: value_of(attribute.value) for attribute in attributes}


@dataclasses.dataclass(frozen=True)
class Span:
    name: str
    kind: str  # SERVER, CLIENT or INTERNAL
    trace: str  # hexadecimal ids
    id: str
    parent: str
    begin: int  # nanoseconds
    end: int
    attributes: dict
    error: str | None  # None: it has not failed
    process: dict  # the attributes of its process

    @staticmethod
    def of(proto, process):
        return Span(
            name=proto.name,
            kind=Proto.SpanKind.Name(proto.kind).removeprefix("SPAN_KIND_"),
            trace=proto.trace_id.hex(),
            id=proto.span_id.hex(),
            parent=proto.parent_span_id.hex(),
            begin=proto.start_time_unix_nano,
            end=proto.end_time_unix_nano,
            attributes=pairs(proto.attributes),
            error=proto.status.message if proto.status.code == proto.status.STATUS_CODE_ERROR else None,
            process=process,
        )


class Collector(trace_service_pb2_grpc.TraceServiceServicer):
    """Keeps all spans. `credentials`: for TLS. `status`: the answer to each batch, if it is not OK."""

    def __init__(self, port=0, credentials=None):
        self.spans = []
        self.metadata = {}  # of the last batch
        self.status = None
        self._changed = threading.Condition()
        self._server = grpc.server(concurrent.futures.ThreadPoolExecutor(2), options=[("grpc.so_reuseport", 0)])
        trace_service_pb2_grpc.add_TraceServiceServicer_to_server(self, self._server)
        address = f"127.0.0.1:{port}"
        if credentials is None:
            self.port = self._server.add_insecure_port(address)
        else:
            self.port = self._server.add_secure_port(address, credentials)
        self._server.start()

    def Export(self, request, context):
        with self._changed:
            self.metadata = dict(context.invocation_metadata())
            if self.status is not None:
                context.abort(self.status, "not now")
            for of_process in request.resource_spans:
                process = pairs(of_process.resource.attributes)
                for scope in of_process.scope_spans:
                    self.spans += [Span.of(span, process) for span in scope.spans]
            self._changed.notify_all()
        return trace_service_pb2.ExportTraceServiceResponse()

    def add(self, span):
        with self._changed:
            self.spans.append(span)
            self._changed.notify_all()

    def wait(self, condition):
        """Waits until `condition(spans)` is true, and returns its value."""
        with self._changed:
            found = self._changed.wait_for(lambda: condition(self.spans), timeout=WAIT)
            assert found, [f"{span.name} of {span.trace}" for span in self.spans]
            return found

    def find(self, name, trace=None, parent=None, **attributes):
        """Waits for a span. Attributes are written with _ for the dots of their names."""

        def condition(spans):
            return next((span for span in spans if matches(span)), None)

        def matches(span):
            own = {key.replace(".", "_"): value for key, value in span.attributes.items()}
            return (
                span.name == name
                and trace in (None, span.trace)
                and parent in (None, span.parent)
                and attributes.items() <= own.items()
            )

        return self.wait(condition)

    def stop(self):
        self._server.stop(None).wait()


@contextlib.contextmanager
def collecting(**options):
    """Starts a collector and yields it."""
    collector = Collector(**options)
    try:
        yield collector
    finally:
        collector.stop()


def environment(port, scheme="http", **further):
    """Returns the variables with which a server sends traces, soon. `further`: without OTEL_."""
    variables = {"EXPORTER_OTLP_ENDPOINT": f"{scheme}://127.0.0.1:{port}", "BSP_SCHEDULE_DELAY": "20"}
    return {f"OTEL_{name}": str(value) for name, value in (variables | further).items()}
