"""Both clients repeat failed calls, and a repeated call takes effect only once."""

import asyncio
import collections
import concurrent.futures
import contextlib
import inspect
import math
import threading

import grpc
import pytest
import spikeserve
from hostile_answers import serving
from spikeserve.status_details import METADATA_KEY, RETRY_INFO, STATUS
from spikeserve.wire import ADMIN_METHODS, ADMIN_SERVICE, METHODS, SERVICE


def retry_info(seconds):
    """Returns a google.rpc.Status that asks to wait. Its code and message are those of the call."""
    info = RETRY_INFO()
    info.retry_delay.FromNanoseconds(int(seconds * 1e9))
    status = STATUS(code=grpc.StatusCode.RESOURCE_EXHAUSTED.value[0])
    status.details.add().Pack(info)
    return status.SerializeToString()


class FlakyServer:
    """Keeps one session. Answers a repeated step or a repeated end with the stored answer.

    `faults` holds the faults of the next calls of each method, in order: "unavailable" rejects the
    call and does nothing, "busy" and "full" reject it with RESOURCE_EXHAUSTED and a delay of 10 ms
    and of a minute, "lost" carries the call out but does not send the answer, "stuck"
    carries the call out and then waits until the caller cancels. On a stream, any fault answers with
    an empty message. `calls` counts the calls of each
    method. `seconds_left` holds the time to the deadline of each call.
    """

    def __init__(self):
        self.faults = collections.defaultdict(list)
        self.calls = collections.Counter()
        self.seconds_left = collections.defaultdict(list)
        self.opened = []
        self.answers = []
        self.rewards = []
        self.episodes = 0
        self.last_end = None
        self.is_open = True

    @contextlib.contextmanager
    def serving(self):
        """Serves on a free port and yields the address."""
        with concurrent.futures.ThreadPoolExecutor() as threads:
            server = grpc.server(threads)
            handlers = {name: self._handler(method) for name, method in METHODS.items()}
            server.add_generic_rpc_handlers([grpc.method_handlers_generic_handler(SERVICE, handlers)])
            port = server.add_insecure_port("127.0.0.1:0")
            server.start()
            yield f"127.0.0.1:{port}"
            server.stop(None).wait()

    def _handler(self, method):
        def handle(request, context):
            self.calls[method.name] += 1
            self.seconds_left[method.name].append(context.time_remaining())
            faults = self.faults[method.name]
            fault = faults.pop(0) if faults else None
            if fault == "unavailable":
                context.abort(grpc.StatusCode.UNAVAILABLE, "the server is draining")
            if fault in ("busy", "full"):
                seconds = 60 if fault == "full" else 0.01
                context.set_trailing_metadata([(METADATA_KEY, retry_info(seconds))])
                context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, "decisions_per_second")
            cancelled = threading.Event()
            context.add_callback(cancelled.set)
            response = getattr(self, method.name)(request, method.response(), context)
            if fault == "lost":
                context.abort(grpc.StatusCode.UNAVAILABLE, "connection reset")
            if fault == "stuck":
                cancelled.wait()
            return response

        if method.streams:
            return grpc.stream_stream_rpc_method_handler(
                self.ActStream, method.request.FromString, method.response.SerializeToString
            )
        return grpc.unary_unary_rpc_method_handler(handle, method.request.FromString, method.response.SerializeToString)

    def OpenSession(self, request, response, context):  # noqa: N802, as in the contract
        self.opened.append(request)
        response.session_id = "s"
        response.action_space.discrete.n = 2
        return response

    def Act(self, request, response, context):  # noqa: N802
        if request.step == len(self.answers):
            self.rewards.append(request.reward)
            response.session_id = "s"
            response.step = request.step
            response.action.discrete = request.step % 2
            response.stats.spikes = 10 + request.step
            response.stats.energy_joules = 0.5
            self.answers.append(response)
        elif request.step != len(self.answers) - 1:
            context.abort(grpc.StatusCode.FAILED_PRECONDITION, "step: out of order")
        return self.answers[-1]

    def ActStream(self, requests, context):  # noqa: N802
        self.calls["ActStream"] += 1
        fault = self.faults["ActStream"].pop() if self.faults["ActStream"] else None
        for request in requests:
            response = METHODS["Act"].response()
            yield response if fault else self.Act(request, response, context)

    def ActBatch(self, request, response, context):  # noqa: N802
        for item in request.requests:
            answer = self.Act(item, METHODS["Act"].response(), context)
            response.results.add().response.CopyFrom(answer)
        return response

    def EndEpisode(self, request, response, context):  # noqa: N802
        if not self.answers and self.last_end is not None and self.last_end[0] == request:
            return self.last_end[1]
        response.episode_return = sum(self.rewards) + request.reward
        response.steps = len(self.answers)
        response.spikes = sum(answer.stats.spikes for answer in self.answers)
        response.energy_joules = sum(answer.stats.energy_joules for answer in self.answers)
        self.answers, self.rewards = [], []
        self.last_end = (request, response)
        self.episodes += 1
        return response

    def CloseSession(self, request, response, context):  # noqa: N802
        if not self.is_open:
            context.abort(grpc.StatusCode.NOT_FOUND, "session: not found")
        self.is_open = False
        return response

    def ListPolicies(self, request, response, context):  # noqa: N802
        return response


ATTEMPTS = 4
RETRY = spikeserve.RetryOptions(max_attempts=ATTEMPTS, initial_backoff=0, max_backoff=0)
PATIENT = spikeserve.ClientOptions(timeout=60, retry=RETRY)
IMPATIENT = spikeserve.ClientOptions(timeout=0.5, retry=RETRY)
QUICK = spikeserve.RetryOptions(initial_backoff=0.05, max_backoff=0.05, max_elapsed=1)
LEARNING = spikeserve.Learning(scope="FLEET", rule="hebbian", clip=0.25)
OBSERVATION = [0.0]


async def finish(result):
    """Awaits `result` if it comes from the asyncio client. Returns its value."""
    return await result if inspect.isawaitable(result) else result


def played(options=PATIENT, session_options=None):
    """Makes a test of the coroutine function test(server, client, session, ...), with both clients of a FlakyServer.

    `options` may be a function of the other arguments.
    """

    def decorate(test):
        @pytest.mark.parametrize("client_class", [spikeserve.Client, spikeserve.AsyncClient])
        def run(client_class, **arguments):
            async def play(address):
                client = client_class(address, options(**arguments) if callable(options) else options)
                session = await finish(client.open_session("any", session_options))
                await test(server, client, session, **arguments)
                await finish(client.close())

            server = FlakyServer()
            with server.serving() as address:
                asyncio.run(play(address))

        more = list(inspect.signature(test).parameters.values())[3:]
        parameter = inspect.Parameter("client_class", inspect.Parameter.KEYWORD_ONLY)
        run.__signature__ = inspect.Signature([*more, parameter])
        run.__doc__ = test.__doc__
        run.pytestmark += getattr(test, "pytestmark", [])
        return run

    return decorate


@played(lambda fault: IMPATIENT if fault == "stuck" else PATIENT)
@pytest.mark.parametrize("fault", ["unavailable", "lost", "stuck"])
async def test_a_repeated_step_is_taken_once(server, client, session, fault):
    for step in range(6):
        server.faults["Act"] = [fault] if step == 2 else []
        decision = await finish(session.act(OBSERVATION, reward=1.0))
        assert (decision.step, decision.action) == (step, step % 2)
    assert server.calls["Act"] >= 7
    summary = await finish(session.end_episode(1.0))
    assert (summary.steps, summary.episode_return) == (6, 6.0)


@pytest.mark.parametrize("client_class", [spikeserve.Client, spikeserve.AsyncClient])
def test_a_batch_that_one_server_refuses_keeps_what_another_has_decided(client_class):
    async def play(servers, addresses):
        client = client_class(",".join(addresses), PATIENT)
        sessions = {}
        while len(sessions) < 2:
            session = await finish(client.open_session("any"))
            sessions[session.cursor.route.replica.address] = session
        at = [sessions[address] for address in addresses]
        with pytest.raises(ValueError, match="observations: expected 2 of them, received 3"):
            await finish(client.act_batch(at, [OBSERVATION] * 3, [0.0, 0.0]))
        with pytest.raises(ValueError, match="observation: expected one dimension"):
            await finish(client.act_batch(at, [OBSERVATION, [OBSERVATION]], [0.0, 0.0]))
        servers[1].faults["ActBatch"] = ["full"]
        decision, error = await finish(client.act_batch(at, [OBSERVATION] * 2, [0.0, 0.0]))
        assert decision.step == 0 and isinstance(error, spikeserve.ResourceExhaustedError)
        results = await finish(client.act_batch(at, [OBSERVATION] * 2, [1.0, 0.0]))
        assert [result.step for result in results] == [1, 0]
        for server in servers:
            server.faults["ActBatch"] = ["full"]
        with pytest.raises(spikeserve.ResourceExhaustedError):
            await finish(client.act_batch(at, [OBSERVATION] * 2, [1.0, 1.0]))
        await finish(client.close())

    servers = [FlakyServer(), FlakyServer()]
    with servers[0].serving() as first, servers[1].serving() as second:
        asyncio.run(play(servers, [first, second]))


def test_a_token_makes_no_call_of_an_operator_shorter():
    for options, timeout in [
        (None, 60.0),
        (spikeserve.ClientOptions(token="secret"), 60.0),
        (spikeserve.ClientOptions(timeout=2.0), 2.0),
    ]:
        with spikeserve.AdminClient("127.0.0.1:1", options) as admin:
            assert admin.options.timeout == timeout
    with spikeserve.Client("127.0.0.1:1") as client:
        assert client.options.timeout == 5.0


@pytest.mark.parametrize("client_class", [spikeserve.AdminClient, spikeserve.AsyncAdminClient])
def test_a_file_that_is_pushed_again_arrives_whole(client_class):
    method, file, calls = ADMIN_METHODS["PushPolicy"], bytes(range(256)) * 300, []

    def receive(requests, context):
        calls.append([request for request in requests])
        if len(calls) == 1:
            context.abort(grpc.StatusCode.UNAVAILABLE, "connection reset")
        return method.response(version=2)

    async def push(address):
        client = client_class(address, PATIENT)
        answer = await finish(client.push_policy(policy="any", sha256="0", data=[file[:7], file[7:]]))
        await finish(client.close())
        return answer

    handler = grpc.stream_unary_rpc_method_handler(
        receive, method.request.FromString, method.response.SerializeToString
    )
    with serving(grpc.method_handlers_generic_handler(ADMIN_SERVICE, {"PushPolicy": handler})) as address:
        assert asyncio.run(push(address)).version == 2
    for head, *parts in calls:
        assert (head.policy, head.sha256, list(head.data)) == ("any", "0", [])
        assert b"".join(data for part in parts for data in part.data) == file
        assert max(part.ByteSize() for part in parts) < 1 << 16


@played()
async def test_a_page_in_the_place_of_an_answer_opens_another_stream(server, client, session):
    server.faults["ActStream"] = ["page"]
    stream = client.act_stream()
    assert (await finish(stream.act(session, OBSERVATION))).step == 0
    assert (await finish(stream.act(session, OBSERVATION, 1.0))).step == 1
    assert server.calls["ActStream"] == 2
    stream.close()


@played()
async def test_the_id_of_a_session_may_be_any_text(server, client, session):
    other = type(session)(client, "s\u00e9ance\n")
    with pytest.raises(spikeserve.SpikeserveError, match="expected step 0 of session s\u00e9ance"):
        await finish(other.act(OBSERVATION))
    assert server.calls["Act"] == 1


ENDLESS = spikeserve.ClientOptions(timeout=math.inf, keepalive=math.inf, keepalive_timeout=1e9, retry=RETRY)


@played(ENDLESS)
async def test_times_without_an_end_have_none(server, client, session):
    await finish(session.act(OBSERVATION, timeout=math.inf))
    await finish(session.end_episode(1.0))
    assert min(server.seconds_left["Act"] + server.seconds_left["EndEpisode"]) > 86400


@played()
async def test_the_last_attempt_raises_and_the_step_may_be_asked_again(server, client, session):
    await finish(session.act(OBSERVATION))
    server.faults["Act"] = ["lost"] * ATTEMPTS
    with pytest.raises(spikeserve.UnavailableError, match="Act: UNAVAILABLE: connection reset"):
        await finish(session.act(OBSERVATION, reward=1.0))
    assert server.calls["Act"] == 1 + ATTEMPTS
    assert session.step == 1
    assert (await finish(session.act(OBSERVATION, reward=1.0))).step == 1
    assert server.rewards == [0.0, 1.0]


@played()
async def test_the_last_deadline_raises(server, client, session):
    server.faults["Act"] = ["stuck"] * ATTEMPTS
    with pytest.raises(spikeserve.DeadlineExceededError, match="Act: DEADLINE_EXCEEDED"):
        await finish(session.act(OBSERVATION, timeout=0.1))
    assert session.step == 0


@played()
async def test_a_refused_call_waits_as_long_as_the_server_asks(server, client, session):
    server.faults["Act"] = ["busy", "busy"]
    assert (await finish(session.act(OBSERVATION))).step == 0
    assert server.calls["Act"] == 3


@played()
async def test_a_pause_that_exceeds_the_timeout_is_not_begun(server, client, session):
    for timeout in (30, None):  # of the call; the default of all retries is 30 s, too
        server.faults["Act"] = ["full"]
        with pytest.raises(spikeserve.ResourceExhaustedError, match="decisions_per_") as refused:
            await finish(session.act(OBSERVATION, timeout=timeout))
        assert refused.value.retry_after == 60
    assert server.calls["Act"] == 2


@played(spikeserve.ClientOptions(timeout=60, retry=QUICK))
async def test_retries_end_after_max_elapsed(server, client, session):
    server.faults["Act"] = ["unavailable"] * 1000
    with pytest.raises(spikeserve.UnavailableError):
        await finish(session.act(OBSERVATION))
    assert 1 < server.calls["Act"] < 1000


@played()
async def test_each_attempt_has_its_deadline(server, client, session):
    server.faults["Act"] = ["unavailable"]
    await finish(session.act(OBSERVATION))
    await finish(session.act(OBSERVATION, 0.0, timeout=7))
    first, second, third = server.seconds_left["Act"]
    assert third < 8 < min(first, second)


@played()
async def test_what_is_wrong_is_not_repeated(server, client, session):
    session.cursor.step = 5
    with pytest.raises(spikeserve.FailedPreconditionError, match="out of order"):
        await finish(session.act(OBSERVATION, 0.0))
    assert server.calls["Act"] == 1


@played(lambda faults: IMPATIENT if faults == ["stuck"] else PATIENT)
@pytest.mark.parametrize("faults", [["unavailable"], ["lost"], ["lost", "unavailable"], ["stuck"]])
async def test_an_end_counts_once_and_its_summary_survives(server, client, session, faults):
    for _ in range(2):
        server.faults["EndEpisode"] = list(faults)
        for _ in range(3):
            await finish(session.act(OBSERVATION, reward=2.0))
        assert await finish(session.end_episode(2.0)) == spikeserve.EpisodeSummary(
            episode_return=6.0, steps=3, spikes=33, energy_joules=1.5
        )
    assert server.episodes == 2


@played()
async def test_a_close_whose_answer_was_lost_is_a_close(server, client, session):
    server.faults["CloseSession"] = ["lost"]
    await finish(session.close())
    assert server.calls["CloseSession"] == 2
    await finish(session.close())  # does nothing
    assert server.calls["CloseSession"] == 2


@played()
async def test_a_batch_is_repeated_as_a_whole(server, client, session):
    server.faults["ActBatch"] = ["lost", "unavailable"]
    (decision,) = await finish(client.act_batch([session], [OBSERVATION], [0.0]))
    assert decision.step == 0
    assert server.calls["ActBatch"] == 3
    assert len(server.answers) == 1


@played()
async def test_a_method_called_by_its_name_is_repeated_too(server, client, session):
    server.faults["ListPolicies"] = ["unavailable"]
    method = METHODS["ListPolicies"]
    assert await finish(client.call(method.name, method.request())) == method.response()
    assert server.calls["ListPolicies"] == 2


@played(session_options=spikeserve.SessionOptions(learning=LEARNING))
async def test_learning_is_asked_for(server, client, session):
    (request,) = server.opened
    assert request.learning.scope == request.learning.FLEET
    assert request.learning.rule == "hebbian"
    assert request.learning.clip == 0.25
    assert not request.learning.HasField("learning_rate")


def test_pauses_grow_to_their_limit():
    options = spikeserve.RetryOptions(max_attempts=6, initial_backoff=1, max_backoff=5, multiplier=2)
    pauses = list(options.pauses())
    assert len(pauses) == 5
    for pause, full in zip(pauses, [1, 2, 4, 5, 5], strict=True):
        assert full / 2 <= pause <= full


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_attempts": 0}, "max_attempts: expected at least 1, received 0"),
        ({"initial_backoff": -1}, "initial_backoff: expected at least 0, received -1"),
        ({"max_backoff": 0}, r"max_backoff: expected at least initial_backoff \(0.05\), received 0"),
        ({"max_elapsed": -1}, "max_elapsed: expected at least 0, received -1"),
        ({"multiplier": 0.5}, "multiplier: expected at least 1, received 0.5"),
    ],
)
def test_retry_options_are_checked(options, message):
    with pytest.raises(ValueError, match=message):
        spikeserve.RetryOptions(**options)
    with pytest.raises(ValueError, match="timeout: expected more than 0, received 0"):
        spikeserve.ClientOptions(timeout=0)
