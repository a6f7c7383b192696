"""Replicas that do not know a session for a moment, because the store has lost it: who of them has it, the client finds."""

import concurrent.futures
import contextlib
import os
import subprocess

import grpc
import pytest
import spikeserve
from serving import DEADLINE_SECONDS
from spikeserve.status_details import METADATA_KEY, STATUS
from spikeserve.wire import METHODS, SERVICE, message_class

OPTIONS = spikeserve.ClientOptions(retry=spikeserve.RetryOptions(initial_backoff=0.001, max_backoff=0.01))
UNKNOWN = (grpc.StatusCode.NOT_FOUND, None)
AWAY = (grpc.StatusCode.UNAVAILABLE, None)
ANSWER = (grpc.StatusCode.OK, None)


def expects(decision):
    return (grpc.StatusCode.FAILED_PRECONDITION, decision)


def out_of_order(decision):
    """Returns a google.rpc.Status that names the expected decision, as server/base/expected_decision.cc does."""
    status = STATUS(code=grpc.StatusCode.FAILED_PRECONDITION.value[0])
    info = message_class("ErrorInfo", "google.rpc")(metadata={"expected_decision": str(decision)})
    status.details.add().Pack(info)
    return status.SerializeToString()


class Replicas:
    """Two servers that answer from `script`: the outcomes of the calls that follow, one for each request of a call.

    `asked` is the number of the server of each call.
    """

    def __init__(self):
        self.script = []
        self.asked = []

    def _outcome(self):
        return self.script.pop(0) if self.script else ANSWER

    def _handle(self, server, method, request, context):
        response = method.response()
        if method.name == "OpenSession":
            response.session_id, response.durability = request.session_id, request.durability
            response.action_space.discrete.n = 2
        elif method.name == "Act":
            self.asked.append(server)
            code, expected = self._outcome()
            if expected is not None:
                context.set_trailing_metadata([(METADATA_KEY, out_of_order(expected))])
            if code is not grpc.StatusCode.OK:
                context.abort(code, f"Act: {code.name}")
            self._answer(request, response)
        elif method.name == "ActBatch":
            self.asked.append(server)
            for act in request.requests:
                code, _ = self._outcome()
                result = response.results.add(code=code.value[0])
                self._answer(act, result.response)
        return response

    @staticmethod
    def _answer(request, response):
        response.session_id, response.step = request.session_id, request.step
        response.action.discrete = 1

    @contextlib.contextmanager
    def serving(self):
        """Yields the addresses."""
        with concurrent.futures.ThreadPoolExecutor() as threads:
            servers, addresses = [], []
            for number in range(2):
                server = grpc.server(threads)
                handlers = {
                    name: grpc.unary_unary_rpc_method_handler(
                        lambda request, context, number=number, method=method: self._handle(
                            number, method, request, context
                        ),
                        method.request.FromString,
                        method.response.SerializeToString,
                    )
                    for name, method in METHODS.items()
                }
                server.add_generic_rpc_handlers([grpc.method_handlers_generic_handler(SERVICE, handlers)])
                addresses.append(f"127.0.0.1:{server.add_insecure_port('127.0.0.1:0')}")
                server.start()
                servers.append(server)
            yield ",".join(addresses)
            for server in servers:
                server.stop(None).wait()


@pytest.fixture
def replicas():
    return Replicas()


class CppClient:
    """What these tests use of the client, in C++: tests/integration/client_player.cc. A session is its number."""

    ERRORS = {"NOT_FOUND": spikeserve.SessionLostError, "FAILED_PRECONDITION": spikeserve.FailedPreconditionError}

    def __init__(self, player):
        self.player = player
        self.sessions = 0

    def open_session(self, policy, options):
        self._ask("OpenSessionResponse", "open", options.to_wire(policy))
        self.sessions += 1
        return CppSession(self)

    def act_batch(self, _, observations, rewards):
        requests = message_class("ActBatchRequest")()
        for observation, reward in zip(observations, rewards, strict=True):
            requests.requests.add(observation=observation, reward=reward)
        answers = self._ask("ActBatchResponse", "act", requests)
        return [spikeserve.Decision.from_wire(result.response) for result in answers.results]

    def _ask(self, answer, word, request):
        print(word, request.SerializeToString().hex(), file=self.player.stdin, flush=True)
        kind, _, error = self.player.stdout.readline().strip().partition(" ")
        if kind == "error":
            code = error.partition(":")[0]
            raise self.ERRORS[code]("Act", grpc.StatusCode[code], error)
        return message_class(answer).FromString(bytes.fromhex(kind))


class CppSession:
    def __init__(self, client):
        self.client = client

    def act(self, observation, reward=0.0):
        return self.client.act_batch([self], [observation], [reward])[0]


@contextlib.contextmanager
def cpp_client(addresses, mode):
    command = [os.environ["CLIENT_PLAYER_PROGRAM"], addresses, mode]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as player:
        yield CppClient(player)
        player.stdin.close()
        assert player.wait(timeout=DEADLINE_SECONDS) == 0


@pytest.fixture(params=["Python", "calls"])
def client(replicas, request):
    """The Python client, or the one in C++, which makes single calls or batches."""
    with contextlib.ExitStack() as stack:
        addresses = stack.enter_context(replicas.serving())
        if request.param == "Python":
            yield stack.enter_context(spikeserve.Client(addresses, OPTIONS))
        else:
            yield stack.enter_context(cpp_client(addresses, request.param))


def opened(client):
    return client.open_session("p", spikeserve.SessionOptions(durability="ASYNC"))


def test_a_replica_that_forgets_before_missing_decisions_arrive_is_not_the_last_word(replicas, client):
    session = opened(client)
    session.act([0.0])
    # The request itself, the missing decision, and the request again: at the other one in the end.
    replicas.script = [expects(0), UNKNOWN, UNKNOWN, ANSWER]
    assert session.act([0.0], 1.0).action == 1
    assert replicas.asked[-1] != replicas.asked[-2]


def test_a_session_is_lost_only_if_all_replicas_in_a_row_do_not_know_it(replicas, client):
    """It moves to the first one while the second one is asked."""
    session = opened(client)
    replicas.script = [UNKNOWN, AWAY, AWAY, UNKNOWN, ANSWER]
    assert session.act([0.0]).action == 1
    replicas.script = [AWAY, UNKNOWN, UNKNOWN]
    with pytest.raises(spikeserve.SessionLostError):
        session.act([0.0], 1.0)
    assert replicas.script == []


def test_a_copy_that_is_too_old_to_be_brought_up_to_date_is_not_the_last_word(replicas, client):
    session = opened(client)
    for _ in range(300):  # more than a client keeps
        session.act([0.0], 1.0)
    replicas.script = [expects(5), ANSWER]
    assert session.act([0.0], 1.0).action == 1
    replicas.script = [expects(5), expects(5)]
    with pytest.raises(spikeserve.FailedPreconditionError):
        session.act([0.0], 1.0)


@pytest.mark.parametrize("client", ["Python", "batch"], indirect=True)
def test_each_session_of_a_batch_is_looked_for_at_all_replicas(replicas, client):
    """One is at the second replica, and the other one, which that does not know, at the first."""
    sessions = [opened(client), opened(client)]
    replicas.script = [UNKNOWN, AWAY, ANSWER, UNKNOWN, ANSWER]
    decisions = client.act_batch(sessions, [[0.0], [0.0]], [0.0, 0.0])
    assert [decision.action for decision in decisions] == [1, 1]


@pytest.mark.parametrize("client", ["Python"], indirect=True)
def test_only_the_session_of_a_batch_that_is_lost_fails(replicas, client):
    sessions = [opened(client), opened(client)]
    replicas.script = [ANSWER, UNKNOWN, UNKNOWN]
    first, second = client.act_batch(sessions, [[0.0], [0.0]], [0.0, 0.0])
    assert first.action == 1 and isinstance(second, spikeserve.SessionLostError)
