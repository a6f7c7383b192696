"""Explanations take long: tenants take turns, and a cancelled call is not computed."""

import concurrent.futures
import json
import threading
import time

import grpc
import pytest
from security import OBSERVATION, POLICY, TOKENS, service_with, until
from serving import DEADLINE_SECONDS, message_class, running_server, series

CALLERS = 24
ANSWERS = 12


@pytest.fixture(scope="module")
def addresses(tmp_path_factory):
    """Starts a server whose tenants may ask for explanations as often as they like."""
    unlimited = {
        name: limits | {"calls_per_second": {"explain": 0}} for name, limits in TOKENS["tenants"].items()
    }
    tokens = tmp_path_factory.mktemp("tokens") / "tokens.json"
    tokens.write_text(json.dumps(TOKENS | {"tenants": unlimited}))
    with running_server(flags=[f"--tokens={tokens}"]) as started:
        yield started


def explainable(service):
    """Opens a session that has decided, and returns its id."""
    session = service.OpenSession(policy="cartpole").session_id
    service.Act(session_id=session, step=0, observation=OBSERVATION)
    return session


class Crowd:
    """Threads that explain one session without pause, each with a connection of its own."""

    def __init__(self, addresses, session, token):
        self.answered = 0
        self.refused = 0
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._addresses, self._session, self._token = addresses, session, token
        self._threads = concurrent.futures.ThreadPoolExecutor(CALLERS)

    def _run(self):
        options = [("grpc.use_local_subchannel_pool", 1)]
        with grpc.insecure_channel(self._addresses.grpc, options) as channel:
            request = message_class(channel, "spikeserve.v1.ExplainRequest")(
                session_id=self._session
            )
            explain = channel.unary_unary(f"/{POLICY}/Explain")
            while not self._stopped.is_set():
                try:
                    explain(
                        request.SerializeToString(),
                        metadata=[("authorization", f"Bearer {self._token}")],
                        timeout=DEADLINE_SECONDS,
                    )
                    answered = True
                except grpc.RpcError as error:
                    assert error.code() == grpc.StatusCode.UNAVAILABLE
                    answered = False
                with self._lock:
                    self.answered += answered
                    self.refused += not answered

    def __enter__(self):
        self._running = [self._threads.submit(self._run) for _ in range(CALLERS)]
        return self

    def __exit__(self, *_):
        self._stopped.set()
        self._threads.shutdown()
        for caller in self._running:
            caller.result()


def test_24_callers_of_one_tenant_leave_another_one_half(addresses):
    with service_with(addresses, "agent") as agent, service_with(addresses, "rival") as rival:
        crowded, alone = explainable(agent), explainable(rival)
        with Crowd(addresses, crowded, "agent") as crowd:
            until(lambda: crowd.refused > 0)  # the queue of the tenant is full
            before = crowd.answered
            for _ in range(ANSWERS):
                rival.Explain(session_id=alone)
            # While the rival's answer travels, the crowd is served more than once in turn.
            assert crowd.answered - before <= 3 * ANSWERS


def computed(addresses):
    return sum(series(addresses, "spikeserve_rpc_duration_seconds_count", token="watchman", method="Explain"))


def test_a_cancelled_call_is_not_computed(addresses):
    with service_with(addresses, "agent") as agent:
        session = explainable(agent)
        request = message_class(addresses.channel, "spikeserve.v1.ExplainRequest")(session_id=session)
        explain = addresses.channel.unary_unary(f"/{POLICY}/Explain")
        metadata = [("authorization", "Bearer agent")]
        before = computed(addresses)
        waiting = [
            explain.future(request.SerializeToString(), metadata=metadata, timeout=DEADLINE_SECONDS)
            for _ in range(14)
        ]
        for call in waiting:
            call.cancel()
        agent.Explain(session_id=session)  # after all of them
        assert computed(addresses) - before <= 7


def test_a_full_queue_is_unavailable_after_a_delay(addresses):
    with service_with(addresses, "agent") as agent:
        session = explainable(agent)
        with Crowd(addresses, session, "agent") as crowd:
            until(lambda: crowd.refused > 0)
            answered, refused, start = crowd.answered, crowd.refused, time.monotonic()
            until(lambda: crowd.answered - answered >= ANSWERS)
            refusals, seconds = crowd.refused - refused, time.monotonic() - start
            # Each caller waits for a tenth of a second on average. Otherwise it would be refused hundreds of times a second.
            assert refusals <= CALLERS * (20 * seconds + 1)
