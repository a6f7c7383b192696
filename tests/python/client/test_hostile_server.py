"""`spikectl` of an operator in front of a server, or an agent, that means harm."""

import contextlib
import json
import math
import os
import random
import subprocess
import urllib.error
import urllib.request
from concurrent import futures

import grpc
import pytest
import spikeserve
from serving import DEADLINE_SECONDS, running_server
from spikeserve.wire import ADMIN_METHODS, ADMIN_SERVICE, METHODS, SERVICE, message_class

ESCAPES = "\x1b]52;c;aGk=\x07\x1b[2J\r\x9b2J\u202e"


def spikectl(address, *arguments):
    command = [os.environ["SPIKECTL_PROGRAM"], *arguments, f"--server={address}"]
    return subprocess.run(command, capture_output=True, timeout=DEADLINE_SECONDS)


INTEGERS = (-5, 0, 1, (1 << 31) - 1, -(1 << 31), (1 << 63) - 1)
NUMBERS = (math.nan, math.inf, -1e30, 0.0, 1.0)


def scalar(field, random):
    """Returns a value that a client may not expect."""
    if field.enum_type is not None:
        return random.choice([0, 1, 77])
    if field.cpp_type in (field.CPPTYPE_DOUBLE, field.CPPTYPE_FLOAT):
        return random.choice(NUMBERS)
    if field.cpp_type == field.CPPTYPE_BOOL:
        return random.random() < 0.5
    if field.cpp_type == field.CPPTYPE_STRING:
        return ESCAPES.encode() if field.type == field.TYPE_BYTES else ESCAPES
    least = 0 if field.cpp_type in (field.CPPTYPE_UINT32, field.CPPTYPE_UINT64) else -(1 << 31)
    greatest = (1 << 31) - 1 if field.cpp_type in (field.CPPTYPE_INT32, field.CPPTYPE_UINT32) else (1 << 63) - 1
    return random.choice([value for value in INTEGERS if least <= value <= greatest])


def fill(message, random, depth=0):
    """Fills most fields of a message with values that a client may not expect. Returns the message."""
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        nested = field.message_type
        if random.random() < 0.15 or field.name == "next_page_token" or (nested is not None and depth > 4):
            continue
        if nested is not None and nested.GetOptions().map_entry:
            of_map = nested.fields_by_name["value"]
            if of_map.message_type is None:
                value[ESCAPES] = scalar(of_map, random)
            else:
                fill(value[ESCAPES], random, depth + 1)
        elif hasattr(value, "add"):
            for _ in range(random.choice((1, 2, 5))):
                fill(value.add(), random, depth + 1)
        elif nested is not None:
            fill(value, random, depth + 1)
        elif hasattr(value, "extend"):
            value.extend([scalar(field, random) for _ in range(random.choice((1, 4, 9)))])
        else:
            setattr(message, field.name, scalar(field, random))
    return message


def plausible(message):
    """Lets a message describe a policy that plays CartPole, so that clients read on."""
    for part in message.policies if hasattr(message, "policies") else [message]:
        known = part.DESCRIPTOR.fields_by_name
        for name, value in {"environment": "CartPole-v1", "observation_size": 4, "context_length": 4, "step": 0}.items():
            if name in known:
                setattr(part, name, value)
        if "action_space" in known:
            part.action_space.discrete.n = 2
        if part is not message:
            part.name, part.version = "x", 1
    return message


@contextlib.contextmanager
def hostile_server(service, method, answer):
    """A server with one method, whose answers are `answer(request)`: a message, or a text for the error."""

    def handle(request, context):
        answered = answer(request)
        if isinstance(answered, str):
            context.abort(grpc.StatusCode.INVALID_ARGUMENT, answered)
        return answered

    request_class = message_class(f"{method}Request")
    handler = grpc.unary_unary_rpc_method_handler(
        handle,
        request_deserializer=request_class.FromString,
        response_serializer=lambda response: response.SerializeToString(),
    )
    server = grpc.server(futures.ThreadPoolExecutor(2))
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(service, {method: handler}),))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        yield f"127.0.0.1:{port}"
    finally:
        server.stop(0).wait()


def explanation(**changes):
    """Returns an explanation of two ticks and two heads."""
    message = message_class("ExplainResponse")(
        ticks=2,
        heads=2,
        policy="p",
        rasters=[{"stage": "key", "population": 3, "ticks": [1], "neurons": [2]}],
        routing=[{"tokens": [{"timestep": 1}], "gates": [0.5] * 4}],
        attention=[{"ticks": 2, "keys": [{"timestep": 1}], "weights": [1.0] * 4}],
    )
    for path, value in changes.items():
        part = message
        *parents, name = path.split("__")
        for parent in parents:
            part = getattr(part, parent)[0]
        if isinstance(value, list):
            part.ClearField(name)
            getattr(part, name).extend(value)
        else:
            setattr(part, name, value)
    return message


BAD = {
    "tick": ({"rasters__ticks": [1 << 30]}, "rasters: expected spikes of the ticks"),
    "negative_tick": ({"rasters__ticks": [-5]}, "rasters: expected spikes of the ticks"),
    "neuron": ({"rasters__neurons": [-1]}, "rasters: expected spikes of the ticks and of the population"),
    "fewer_neurons": ({"rasters__neurons": []}, "rasters: expected a tick and a neuron of each spike"),
    "ticks": ({"ticks": 1 << 30}, "ticks: expected 1 to 256"),
    "no_ticks": ({"ticks": 0}, "ticks: expected 1 to 256"),
    "heads": ({"heads": 1 << 30}, "heads: expected 1 to 64"),
    "negative_heads": ({"heads": -1}, "heads: expected 1 to 64"),
    "gates": ({"routing__gates": [0.5]}, "routing.gates: expected one for each token, tick and head"),
    "tokens": ({"routing__tokens": [], "routing__gates": []}, "routing.gates: expected one for each token"),
    "weights": ({"attention__weights": [1.0]}, "attention.weights: expected one for each tick, head and key"),
    "attention_ticks": ({"attention__ticks": 1 << 30}, "attention.weights: expected one for each tick"),
    "kind": ({"attention__keys__kind": 77}, "token.kind: expected one of three kinds"),
}


@pytest.mark.parametrize(("changes", "reason"), BAD.values(), ids=BAD)
def test_no_number_of_an_explanation_is_an_index_unchecked(changes, reason):
    with hostile_server(SERVICE, "Explain", lambda _: explanation(**changes)) as address:
        done = spikectl(address, "explain", "--session=x")
    assert done.returncode == 1, done.stderr
    assert reason in done.stderr.decode()


def test_an_explanation_without_faults_is_printed():
    with hostile_server(SERVICE, "Explain", lambda _: explanation()) as address:
        done = spikectl(address, "explain", "--session=x")
    assert done.returncode == 0, done.stderr
    assert "layer 0 head 1 attends most to: G_1 1.000" in done.stdout.decode()


def check_shown(output):
    text = output.decode()
    assert not [c for c in text if c not in "\n\t" and (ord(c) < 32 or 127 <= ord(c) < 160 or ord(c) == 0x202E)], text
    return text


def check_harmless(output):
    """Asserts that a terminal shows these bytes, of ESCAPES, and obeys none."""
    text = check_shown(output)
    assert "\\u001b]52;c;aGk=\\u0007" in text


def test_names_of_a_server_are_escaped():
    message = explanation(policy=ESCAPES)
    with hostile_server(SERVICE, "Explain", lambda _: message) as address:
        check_harmless(spikectl(address, "explain", "--session=x").stdout)
        printed = spikectl(address, "explain", "--session=x", "--json").stdout
        check_harmless(printed)
        json.loads(printed)


def test_errors_of_a_server_are_escaped():
    with hostile_server(SERVICE, "ListPolicies", lambda _: f"policy: expected {ESCAPES}") as address:
        done = spikectl(address, "policies")
    assert done.returncode == 1
    check_harmless(done.stderr)


POLICY = ("--policy=x", "--version=1")
COMMANDS = [
    *(["policies", *flags] for flags in ([], ["--all"], ["--features"])),
    *([command, "--env=CartPole-v1", "--episodes=1"] for command in ("run", "adapt")),
    ["explain", "--env=CartPole-v1", "--steps=2"],
    *([command, "--session=x"] for command in ("explain", "doctor")),
    *(["admin", action, *POLICY] for action in ("load", "unload", "default")),
    ["admin", "label", *POLICY, "--label=a"],
    ["admin", "unlabel", POLICY[0], "--label=a"],
    *(["admin", action, POLICY[0]] for action in ("rollout", "head", "promote_head", "reset_head", "pause_learning")),
    *(["admin", action] for action in ("rollouts", "history", "reload", "sessions", "drain")),
]


@pytest.fixture(scope="module")
def random_server():
    """A server whose every answer has values that nobody expects. Yields its address, and the source of the values."""
    source = {}

    class Everything(grpc.GenericRpcHandler):
        def service(self, details):
            method = (METHODS | ADMIN_METHODS).get(details.method.rpartition("/")[2])
            if method is None:  # a health check: SERVING
                return grpc.unary_unary_rpc_method_handler(lambda *_: b"\x08\x01")

            def answer():
                message = fill(method.response(), source["random"])
                return plausible(message) if source["plausible"] else message

            make = grpc.stream_stream_rpc_method_handler if method.streams else grpc.unary_unary_rpc_method_handler
            handle = (lambda requests, _: (answer() for _ in requests)) if method.streams else (lambda *_: answer())
            return make(handle, method.request.FromString, lambda response: response.SerializeToString())

    server = grpc.server(futures.ThreadPoolExecutor(4))
    server.add_generic_rpc_handlers((Everything(),))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield f"127.0.0.1:{port}", source
    server.stop(0).wait()


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_no_answer_crashes_a_command_or_reaches_the_terminal_raw(command, random_server):
    address, source = random_server
    for seed in range(4):
        source |= {"random": random.Random(seed), "plausible": seed > 0}
        done = spikectl(address, *command, *(["--json"] if seed % 2 else []))
        assert done.returncode in (0, 1), done
        check_shown(done.stdout + done.stderr)


def test_pages_without_end_have_an_end():
    calls = 0

    def page(_):
        nonlocal calls
        calls += 1
        sessions = [] if calls == 3 else [{"session_id": ESCAPES}]
        return message_class("ListSessionsResponse")(sessions=sessions, next_page_token=f"page {calls}")

    with hostile_server(ADMIN_SERVICE, "ListSessions", page) as address:
        done = spikectl(address, "admin", "sessions")
    assert done.returncode == 1
    reason = "sessions: expected at most 1000 pages, each with sessions, received 0 sessions and another page after 2"
    assert reason in done.stderr.decode()


def test_an_agent_chooses_no_name_that_an_operators_terminal_obeys():
    with running_server() as server, spikeserve.Client(server.grpc) as client:
        for labels in ({"robot": ESCAPES}, {"a\nb": "x"}):
            with pytest.raises(spikeserve.InvalidArgumentError, match="labels: expected printable characters in UTF-8"):
                client.open_session("cartpole", spikeserve.SessionOptions(labels=labels)).__enter__()
        with client.open_session("cartpole", spikeserve.SessionOptions(labels={"robot": "Müller 7"})):
            pass
        body = {
            "inputs": [{"name": "observation", "shape": [4], "datatype": "FP32", "data": [0, 0, 0, 0]}],
            "parameters": {"sequence_id": ESCAPES, "sequence_start": True},
        }
        address = f"http://{server.http}/v2/models/cartpole/infer"
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(address, json.dumps(body).encode())
        assert "sequence_id: expected printable characters in UTF-8" in refused.value.read().decode()
