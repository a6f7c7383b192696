"""`spikectl` of an operator in front of a server, or an agent, that means harm."""

import hashlib
import json
import re
import urllib.error
import urllib.request

import grpc
import pytest
import spikeserve
from hostile_answers import COMMANDS, ESCAPES, RandomAnswers, check_shown, plausible, serving, spikectl
from serving import running_server
from spikeserve.wire import ADMIN_SERVICE, METHODS, SERVICE, message_class


def hostile_server(service, method, answer):
    """Serves one method, whose answers are `answer(request)`: a message, or a text for the error."""

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
    return serving(grpc.method_handlers_generic_handler(service, {method: handler}))


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


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        ({"size": 1 << 40, "data": b"x" * (1 << 20)}, "size: expected 0 to 4294967296 bytes, received 1099511627776"),
        ({"size": -1}, "size: expected 0 to 4294967296 bytes, received -1"),
        ({"size": 1 << 32, "data": b"x"}, "data: expected 1048576 bytes, received 1"),
        ({"size": 10}, "data: expected 10 bytes, received 0"),
    ],
)
def test_a_file_without_end_is_not_pulled(answer, reason, tmp_path):
    pulled = message_class("PullPolicyResponse")(version=1, **answer)
    with hostile_server(ADMIN_SERVICE, "PullPolicy", lambda _: pulled) as address:
        done = spikectl(address, "pull", str(tmp_path / "pulled"), "--policy=x", "--version=1")
    assert done.returncode == 1
    assert reason in done.stderr.decode()
    assert not list(tmp_path.iterdir())


def test_no_signature_of_another_file_stays_beside_one_that_is_pulled(tmp_path):
    pulled = tmp_path / "pulled"
    signature = tmp_path / "pulled.sig"
    signature.write_bytes(b"of another file")
    data = b"policy"
    answer = {"size": len(data), "data": data, "sha256": hashlib.sha256(data).hexdigest()}
    response = message_class("PullPolicyResponse")(version=1, **answer)
    with hostile_server(ADMIN_SERVICE, "PullPolicy", lambda _: response) as address:
        assert spikectl(address, "pull", str(pulled), "--policy=x").returncode == 0
    assert pulled.read_bytes() == data
    assert not signature.exists()


def test_a_lease_has_its_name_before_a_call_is_repeated():
    leases = []

    def refuse(request):
        leases.append(request.lease_id)
        return "lease_seconds: expected another one"

    with hostile_server(ADMIN_SERVICE, "TakeControl", refuse) as address:
        assert spikectl(address, "take", "--session=x").returncode == 1
    assert re.fullmatch("[0-9a-f]{32}", leases[0])


def test_an_episode_is_whole_or_an_error():
    """A server that loses the session at every step 1."""

    def handler(name):
        def handle(request, context):
            response = METHODS[name].response()
            if name == "ListPolicies":
                response.policies.add(is_default=True)
            if name == "OpenSession":
                response.session_id, response.version = request.session_id, 1
            if name != "Act":
                return plausible(response)
            if request.step > 0:
                context.abort(grpc.StatusCode.NOT_FOUND, "session_id: expected one that is open")
            response.session_id, response.action.discrete = request.session_id, 0
            return response

        return grpc.unary_unary_rpc_method_handler(
            handle, METHODS[name].request.FromString, lambda response: response.SerializeToString()
        )

    names = ("ListPolicies", "OpenSession", "Act", "EndEpisode", "CloseSession")
    with serving(grpc.method_handlers_generic_handler(SERVICE, {name: handler(name) for name in names})) as address:
        done = spikectl(address, "run", "--env=CartPole-v1", "--seed=7", "--reopen")
    assert done.returncode == 1
    assert "the session was lost in each of 3 tries of the episode with seed 7" in done.stderr.decode()


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


@pytest.fixture(scope="module")
def random_server():
    """Yields the address of a server with RandomAnswers, and these."""
    answers = RandomAnswers()
    with serving(answers) as address:
        yield address, answers


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_no_answer_crashes_a_command_or_reaches_the_terminal_raw(command, random_server):
    address, answers = random_server
    for seed in range(4):
        answers.begin(seed)
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
