"""Traces of a real server, as a collector receives them."""

import os
import re
import subprocess

import grpc
import pytest
import spikeserve
from opentelemetry import trace
from opentelemetry.sdk.trace import TracerProvider
from redis_servers import WITHOUT_REDIS, free_port
from replicated import running_fleet
from security import until
from serving import SHIPPED_POLICIES, Service, http_call, page_of, running_server
from traces import collecting, environment

SERVICE = "spikeserve.v1.PolicyService"
ACT, OPEN, END = (f"{SERVICE}/{method}" for method in ("Act", "OpenSession", "EndEpisode"))
OBSERVATION = [0.0, 0.1, 0.0, -0.1]
WAIT = 120  # seconds for what takes a moment
TRACER = TracerProvider().get_tracer("agent")  # of this process, whose spans go nowhere


@pytest.fixture
def collector():
    with collecting() as started:
        yield started


@pytest.fixture
def serve(collector, monkeypatch):
    """Returns running_server(), whose server sends its traces to `collector`."""

    def start(flags=(), status=0, **further):
        for name, value in environment(collector.port, **further).items():
            monkeypatch.setenv(name, value)
        return running_server(flags=flags, status=status)

    return start


def ids(span):
    """Returns the ids of a span of this process, as a collector's."""
    context = span.get_span_context()
    return f"{context.trace_id:032x}", f"{context.span_id:016x}"


def header(trace_id, sampled, span="00f067aa0ba902b7"):
    return f"00-{trace_id}-{span}-{'01' if sampled else '00'}"


class Caller:
    """Calls a server with a `traceparent` of its own."""

    def __init__(self, address):
        self._channel = grpc.insecure_channel(address)
        service = Service(self._channel, SERVICE)
        self.session_id = service.OpenSession(policy="cartpole").session_id
        self.steps = 0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._channel.close()

    def act(self, *traceparents):
        request = spikeserve.wire.message_class("ActRequest")(
            session_id=self.session_id, step=self.steps, observation=OBSERVATION, reward=1.0
        )
        self.steps += 1
        metadata = [("traceparent", traceparent) for traceparent in traceparents]
        method = spikeserve.wire.METHODS["Act"].bind(self._channel)
        return method(request, metadata=metadata, timeout=WAIT)


def counted(server):
    """Returns spikeserve_trace_spans_total by outcome."""
    page = page_of(server, "/metrics")
    pattern = r'spikeserve_trace_spans_total\{outcome="(\w+)"\} (\d+)'
    return {outcome: int(count) for outcome, count in re.findall(pattern, page)}


def test_a_decision_belongs_to_the_span_of_the_agent_and_tells_what_it_cost(collector, serve):
    resource = {"SERVICE_NAME": "arm", "RESOURCE_ATTRIBUTES": "site=hall%202,service.version=7"}
    with serve(**resource) as addresses, spikeserve.Client(addresses.grpc) as client:
        session = client.open_session("cartpole")
        with TRACER.start_as_current_span("think") as span:
            decision = session.act(OBSERVATION)
        trace_id, parent = ids(span)
        decide = collector.find("decide", trace=trace_id)
        call = collector.find(ACT, trace=trace_id)
    assert (call.parent, call.kind, call.error) == (parent, "SERVER", None)
    assert call.attributes == {
        "rpc.system.name": "grpc",
        "rpc.method": ACT,
        "rpc.response.status_code": "OK",
    }
    assert (decide.parent, decide.kind) == (call.id, "INTERNAL")
    stats = decision.stats
    assert decide.attributes == {
        "spikeserve.policy": "cartpole",
        "spikeserve.policy.version": session.opening.version,
        "spikeserve.session.id": session.session_id,
        "spikeserve.episode": 0,
        "spikeserve.step": 0,
        "spikeserve.spikes": stats.spikes,
        "spikeserve.synaptic_operations": stats.synaptic_operations,
        "spikeserve.energy_joules": stats.energy_joules,
        "spikeserve.compute_seconds": stats.compute_seconds,
    }
    assert call.begin <= decide.begin <= decide.end <= call.end
    assert call.process.items() >= {"service.name": "arm", "site": "hall 2", "service.version": "7"}.items()
    assert call.process["process.pid"] == addresses.process.pid


def test_each_request_of_a_stream_belongs_to_its_own_span(collector, serve):
    with serve() as addresses, spikeserve.Client(addresses.grpc) as client:
        session = client.open_session("cartpole")
        expected = []
        with client.act_stream() as stream:
            for step in range(3):
                with TRACER.start_as_current_span(f"step {step}") as span:
                    stream.act(session, OBSERVATION, 1.0)
                expected.append(ids(span))
            stream.act(session, OBSERVATION, 1.0)  # without a span
        for trace_id, parent in expected:
            call = collector.find(f"{SERVICE}/ActStream", trace=trace_id, parent=parent)
            collector.find("decide", trace=trace_id, parent=call.id)


def test_each_beat_of_a_pilot_belongs_to_its_own_span(collector, serve):
    with serve() as addresses, spikeserve.Client(addresses.grpc) as client:
        options = {"period": 0.02, "max_age": 30.0}
        with spikeserve.Pilot(client, "cartpole", **options) as pilot:
            beats = []

            def is_traced():
                with TRACER.start_as_current_span("beat") as span:
                    pilot.beat(OBSERVATION, 1.0)
                beats.append(ids(span))
                return any((span.trace, span.parent) in beats for span in list(collector.spans))

            until(is_traced)


def test_a_batch_is_one_call_with_many_decisions(collector, serve):
    with serve() as addresses, spikeserve.Client(addresses.grpc) as client:
        sessions = [client.open_session("cartpole") for _ in range(3)]
        with TRACER.start_as_current_span("batch") as span:
            client.act_batch(sessions, [OBSERVATION] * 3, [0.0] * 3)
        trace_id, parent = ids(span)
        call = collector.find(f"{SERVICE}/ActBatch", trace=trace_id, parent=parent)
        for session in sessions:
            collector.find("decide", parent=call.id, spikeserve_session_id=session.session_id)


def test_the_caller_decides_what_is_sampled_and_who_brings_no_decision_is_drawn(collector, serve):
    """Spans end in their order, so that the last one tells that no others come."""
    with serve(TRACES_SAMPLER="parentbased_always_off") as addresses, Caller(addresses.grpc) as caller:
        unsampled = ["", header("1" * 32, False), header("0" * 32, True), header("2" * 31 + "X", True)]
        for traceparent in unsampled:
            caller.act(*[traceparent] if traceparent else [])
        caller.act(header("a" * 32, True))
        collector.find("decide", trace="a" * 32)
    assert {span.trace for span in collector.spans} == {"a" * 32}


def test_a_share_of_the_requests_is_sampled(collector, serve):
    options = {"TRACES_SAMPLER": "parentbased_traceidratio", "TRACES_SAMPLER_ARG": "0.5"}
    with serve(**options) as addresses, Caller(addresses.grpc) as caller:
        for _ in range(200):
            caller.act()
        caller.act(header("a" * 32, True))
        collector.find("decide", trace="a" * 32)
    # Of 200 fair draws fewer than 50 come once in 10^12 runs.
    assert 50 < len([span for span in collector.spans if span.name == "decide"]) < 150


def test_without_an_endpoint_nothing_is_sent_and_the_rest_is_not_read(collector, monkeypatch):
    monkeypatch.setenv("OTEL_TRACES_SAMPLER", "nonsense of another program")
    with running_server() as addresses, Caller(addresses.grpc) as caller:
        caller.act(header("a" * 32, True))
        assert counted(addresses) == {}
    for name, value in environment(collector.port, SDK_DISABLED="true").items():
        monkeypatch.setenv(name, value)
    with running_server() as addresses, Caller(addresses.grpc) as caller:
        caller.act(header("a" * 32, True))
        assert counted(addresses) == {}


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("EXPORTER_OTLP_ENDPOINT", "localhost:4317", "http://HOST:PORT or https://HOST:PORT"),
        ("EXPORTER_OTLP_TRACES_ENDPOINT", "http://a:b", "http://HOST:PORT or https://HOST:PORT"),
        ("EXPORTER_OTLP_PROTOCOL", "http/protobuf", "grpc"),
        ("EXPORTER_OTLP_COMPRESSION", "gzip", "none"),
        ("EXPORTER_OTLP_TIMEOUT", "1s", "a whole number of at least 1"),
        ("EXPORTER_OTLP_HEADERS", "secret", "NAME=VALUE,NAME=VALUE"),
        ("TRACES_SAMPLER", "sometimes", "always_on, always_off or traceidratio"),
        ("TRACES_EXPORTER", "zipkin", "otlp or none"),
        ("SDK_DISABLED", "yes", "true or false"),
        ("RESOURCE_ATTRIBUTES", "a", "KEY=VALUE,KEY=VALUE"),
        ("PROPAGATORS", "b3", "tracecontext, baggage or none"),
        ("BSP_MAX_QUEUE_SIZE", "0", "a whole number of at least 1"),
    ],
)
def test_a_value_that_is_not_understood_is_named(name, value, expected):
    variables = os.environ | environment(4317, **{name: value})
    program = [os.environ["SPIKESERVE_PROGRAM"], f"--policies={SHIPPED_POLICIES}", "--listen=127.0.0.1:0"]
    ended = subprocess.run(
        [*program, "--http_listen="], env=variables, stderr=subprocess.PIPE, text=True, timeout=WAIT
    )
    assert ended.returncode != 0
    assert f"OTEL_{name}: expected {expected}" in ended.stderr
    assert ("secret" in ended.stderr) == (name != "EXPORTER_OTLP_HEADERS" and value == "secret")


def test_a_full_buffer_drops_and_counts_and_nothing_waits_for_it(monkeypatch):
    absent = environment(free_port(), BSP_MAX_QUEUE_SIZE=8, BSP_MAX_EXPORT_BATCH_SIZE=4)
    for name, value in absent.items():
        monkeypatch.setenv(name, value)
    with running_server() as addresses, Caller(addresses.grpc) as caller:
        for _ in range(50):
            caller.act()
        # Each call has two spans. The buffer holds 8, and a batch of 4 waits for the next try.
        assert counted(addresses)["dropped"] >= 50
        assert counted(addresses)["exported"] == 0


def test_a_collector_that_comes_back_gets_what_waits(serve, collector):
    with serve() as addresses, Caller(addresses.grpc) as caller:
        caller.act(header("a" * 32, True))
        collector.find("decide", trace="a" * 32)
        collector.stop()
        caller.act(header("b" * 32, True))
        with collecting(port=collector.port) as again:
            again.find("decide", trace="b" * 32)
            until(lambda: counted(addresses)["failed"] == 0)


def test_what_a_collector_refuses_is_counted(serve, collector):
    collector.status = grpc.StatusCode.INVALID_ARGUMENT
    with serve() as addresses, Caller(addresses.grpc) as caller:
        caller.act()
        until(lambda: counted(addresses)["failed"] >= 2)
        assert counted(addresses)["exported"] == 0


def test_the_last_spans_are_sent_before_the_server_ends(serve, collector):
    with serve(BSP_SCHEDULE_DELAY=3_600_000) as addresses, Caller(addresses.grpc) as caller:
        caller.act(header("a" * 32, True))
    assert "decide" in {span.name for span in collector.spans if span.trace == "a" * 32}


def test_a_collector_over_tls_gets_a_certificate_and_headers(certificates, monkeypatch):
    read = {name: (certificates / name).read_bytes() for name in ("ca.pem", "server.pem", "server.key")}
    credentials = grpc.ssl_server_credentials(
        [(read["server.key"], read["server.pem"])], read["ca.pem"], require_client_auth=True
    )
    files = {
        "EXPORTER_OTLP_CERTIFICATE": certificates / "ca.pem",
        "EXPORTER_OTLP_CLIENT_CERTIFICATE": certificates / "client.pem",
        "EXPORTER_OTLP_CLIENT_KEY": certificates / "client.key",
        "EXPORTER_OTLP_HEADERS": "X-Api-Key=open%20sesame",
    }
    with collecting(credentials=credentials) as collector:
        for name, value in environment(collector.port, scheme="https", **files).items():
            monkeypatch.setenv(name, value)
        with running_server() as addresses, Caller(addresses.grpc) as caller:
            caller.act(header("a" * 32, True))
            collector.find("decide", trace="a" * 32)
    assert collector.metadata["x-api-key"] == "open sesame"


def test_loads_are_traced_and_those_of_an_operator_belong_to_his_call(serve, collector):
    with serve() as addresses:
        start = collector.find("load", spikeserve_policy="cartpole", spikeserve_policy_version=1)
        assert start.parent == ""
        addresses.admin.LoadPolicy(policy="cartpole", version=1)
        call = collector.find("spikeserve.v1.PolicyAdmin/LoadPolicy")
        collector.find("load", trace=call.trace, parent=call.id, spikeserve_policy="cartpole")


def test_an_error_of_the_caller_is_none_of_the_server(serve, collector):
    with serve() as addresses, Caller(addresses.grpc) as caller:
        caller.session_id = "0" * 32
        with pytest.raises(grpc.RpcError):
            caller.act(header("a" * 32, True))
        call = collector.find(ACT, trace="a" * 32)
    assert (call.attributes["rpc.response.status_code"], call.error) == ("NOT_FOUND", None)


def test_http_inference_passes_its_header_on(serve, collector):
    with serve() as addresses:
        http_call(addresses.http, "GET", "/v2/health/live", traceparent=header("a" * 32, True))
        collector.find("inference.GRPCInferenceService/ServerLive", trace="a" * 32)


def test_the_merge_of_a_fleet_without_a_store_is_traced(serve, collector):
    with serve() as addresses, spikeserve.Client(addresses.grpc) as client:
        learning = spikeserve.Learning(scope="FLEET", learning_rate=0.1)
        session = client.open_session("cartpole", spikeserve.SessionOptions(learning=learning))
        session.act(OBSERVATION)
        session.end_episode(1.0, terminated=True)
        call = collector.find(END)
        collector.find("merge", parent=call.id)


@WITHOUT_REDIS
@pytest.mark.parametrize("durability", ["ASYNC", "SYNC"])
def test_two_replicas_trace_what_goes_through_redis(collector, monkeypatch, durability):
    for name, value in environment(collector.port).items():
        monkeypatch.setenv(name, value)
    options = spikeserve.SessionOptions(
        durability=durability, learning=spikeserve.Learning(scope="FLEET", learning_rate=0.1)
    )
    with running_fleet(replicas=2) as fleet, spikeserve.Client(fleet.addresses) as client:
        session = client.open_session("cartpole", options)
        with TRACER.start_as_current_span("think") as span:
            session.act(OBSERVATION)
        trace_id, _ = ids(span)
        call = collector.find(ACT, trace=trace_id)
        append = collector.find("append", parent=call.id)
        assert (append.kind, append.attributes["db.system.name"]) == ("CLIENT", "redis")
        if durability == "SYNC":  # the answer has waited
            assert append.end <= call.end

        session.end_episode(1.0, terminated=True)
        end = collector.find(END)
        merge = collector.find("merge", parent=end.id)
        assert merge.begin >= collector.find("append", parent=end.id).end

        owner = append.process["process.pid"]
        for replica in fleet.replicas:
            if replica.pid == owner:
                replica.kill()
        with TRACER.start_as_current_span("think on") as span:
            session.act(OBSERVATION)
        trace_id, _ = ids(span)
        claim = collector.find("claim", trace=trace_id, spikeserve_found=1)
        assert (claim.kind, claim.attributes["db.system.name"]) == ("CLIENT", "redis")
        assert claim.attributes["spikeserve.session.id"] == session.session_id
        assert claim.process["process.pid"] != owner
        collector.find("decide", trace=trace_id, parent=claim.parent)


def test_a_client_of_a_program_without_opentelemetry_sends_no_trace():
    program = """
import sys
from spikeserve.trace_context import active_traceparent
assert "opentelemetry" not in sys.modules
assert active_traceparent() == ""
"""
    subprocess.run([os.sys.executable, "-c", program], check=True, timeout=WAIT)


def test_a_client_without_an_active_span_sends_no_trace():
    assert trace.get_current_span().get_span_context().is_valid is False
    assert spikeserve.trace_context.active_traceparent() == ""
