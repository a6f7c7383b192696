"""A PolicyService that runs in the process of the test and fails on demand."""

import collections
import concurrent.futures
import contextlib
import threading

import grpc
from spikeserve.status_details import METADATA_KEY, RETRY_INFO, STATUS
from spikeserve.wire import METHODS, SERVICE


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
    carries the call out and then waits until the caller cancels. `calls` counts the calls of each
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
            server.add_generic_rpc_handlers(
                [grpc.method_handlers_generic_handler(SERVICE, handlers)]
            )
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

        return grpc.unary_unary_rpc_method_handler(
            handle, method.request.FromString, method.response.SerializeToString
        )

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

    def ActBatch(self, request, response, context):  # noqa: N802
        for item in request.requests:
            answer = self.Act(item, METHODS["Act"].response(), context)
            response.results.add().response.CopyFrom(answer)
        return response

    def EndEpisode(self, request, response, context):  # noqa: N802
        if not self.answers and self.last_end is not None and self.last_end[0] == request:
            return self.last_end[1]
        if not self.answers:
            context.abort(grpc.StatusCode.FAILED_PRECONDITION, "step: expected a decision")
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
