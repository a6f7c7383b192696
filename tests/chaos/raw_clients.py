"""Sessions of clients that use the stubs alone: no affinity, and perhaps hedging.

Each request goes to any replica, or to two at once. A request that fails goes to any replica again; if one expects an older
decision, the requests from there on are sent again. A session is lost only if no replica knows it: Redis may have removed
it, and its owner writes it again when it is asked. This is all that a client of another language has to do.
"""

import asyncio
import collections
import random
import time

import grpc
import grpc.aio
from spikeserve.status_details import details_of
from spikeserve.wire import SERVICE, message_class

KEPT = 300  # requests
MOST_UNKNOWN = 50  # tries in a row at replicas that do not know a session, chosen at random
SHORTEST_PAUSE, LONGEST_PAUSE = 0.01, 0.2  # seconds between tries
RECONNECT = [("grpc.initial_reconnect_backoff_ms", 50), ("grpc.max_reconnect_backoff_ms", 200)]
TRANSIENT = (
    grpc.StatusCode.UNAVAILABLE,
    grpc.StatusCode.DEADLINE_EXCEEDED,
    grpc.StatusCode.CANCELLED,
    grpc.StatusCode.INTERNAL,  # a connection that breaks
    grpc.StatusCode.UNKNOWN,
)


class WrongAnswerError(Exception):
    """A request had two answers that differ."""


class RawStubs:
    """The calls of PolicyService at each of the replicas `servers`."""

    def __init__(self, servers, timeout):
        self._channels = [grpc.aio.insecure_channel(address, RECONNECT) for address in servers.split(",")]
        self.timeout = timeout
        self.addresses = servers.split(",")
        names = {"Act": "ActResponse", "EndEpisode": "EndEpisodeResponse"}
        self.calls = [
            {
                name: channel.unary_unary(
                    f"/{SERVICE}/{name}",
                    request_serializer=lambda message: message.SerializeToString(),
                    response_deserializer=message_class(answer).FromString,
                )
                for name, answer in names.items()
            }
            for channel in self._channels
        ]

    async def close(self):
        """Closes the connections."""
        await asyncio.gather(*(channel.close() for channel in self._channels))


def comparable_bytes(answer):
    """Returns an answer without what differs from run to run."""
    copy = type(answer)()
    copy.CopyFrom(answer)
    if copy.DESCRIPTOR.name == "ActResponse":
        copy.stats.ClearField("compute_seconds")
        copy.ClearField("durable_decision")
    return copy.SerializeToString(deterministic=True)


class _Sent:
    """A request, and its answer if there was one. `decision` is that of an Act, and that after an end."""

    def __init__(self, name, message, decision):
        self.name = name
        self.message = message
        self.decision = decision
        self.answer = None

    def take(self, answer):
        bytes_ = comparable_bytes(answer)
        if self.answer is not None and comparable_bytes(self.answer) != bytes_:
            raise WrongAnswerError(f"{self.name} of decision {self.decision}: {self.message.session_id}")
        self.answer = answer


class RawSession:
    """Plays an open session. With `hedges`, each request goes to two replicas at once."""

    def __init__(self, stubs, session_id, hedges, patience):
        self._stubs = stubs
        self._id = session_id
        self._hedges = hedges
        self._patience = patience
        self._kept = collections.deque(maxlen=KEPT)
        self._decision = 0
        self._episode = 0
        self._step = 0
        self._late = set()  # tasks of hedged requests whose answer is compared when it arrives

    async def act(self, observation, reward):
        """Returns the ActResponse and the address of the replica that has sent it."""
        message = message_class("ActRequest")(
            session_id=self._id, step=self._step, observation=observation, reward=reward, decision=self._decision
        )
        answered = await self._send(_Sent("Act", message, self._decision))
        self._decision += 1
        self._step += 1
        return answered

    async def end_episode(self, reward):
        """Returns the EndEpisodeResponse and the address of the replica that has sent it."""
        message = message_class("EndEpisodeRequest")(
            session_id=self._id, reward=reward, terminated=True, episode=self._episode, steps=self._step
        )
        answered = await self._send(_Sent("EndEpisode", message, self._decision))
        self._episode += 1
        self._step = 0
        return answered

    async def settle(self):
        """Waits for late answers, and returns the address of a replica that has the session as it is."""
        await asyncio.gather(*self._late)
        _, address = await self._exchange_all(len(self._kept) - 1)
        return address

    async def _send(self, sent):
        self._kept.append(sent)
        return await self._exchange_all(len(self._kept) - 1)

    async def _exchange_all(self, last):
        """Sends request `last` of those that are kept, and the ones before that a replica asks for."""
        give_up = time.monotonic() + self._patience
        at = last
        unknown = 0
        while True:
            sent = self._kept[at]
            try:
                answer, address = await self._try(sent)
            except grpc.aio.AioRpcError as error:
                expected = details_of(error).expected_decision
                # It does not know the session, or writes a copy that is too old: another one has a newer one.
                is_unknown = error.code() == grpc.StatusCode.NOT_FOUND
                is_outdated = expected is not None and expected < self._kept[0].decision
                unknown = unknown + 1 if is_unknown or is_outdated else 0
                is_transient = error.code() in TRANSIENT or ((is_unknown or is_outdated) and unknown < MOST_UNKNOWN)
                expected = None if is_outdated else expected
                if time.monotonic() > give_up or (not is_transient and expected is None):
                    raise
                at = last if expected is None else self._first_from(expected, at)
                await asyncio.sleep(random.uniform(SHORTEST_PAUSE, LONGEST_PAUSE))
                continue
            sent.take(answer)
            if at == last:
                return answer, address
            at += 1

    def _first_from(self, expected, at):
        """Returns the request from which a replica continues that expects decision `expected`."""
        if expected > self._kept[-1].decision:
            return len(self._kept) - 1  # it has all of them, and answers the last one again
        first = next((i for i, sent in enumerate(self._kept) if sent.decision == expected), None)
        assert first is not None, f"expected a kept decision, received {expected} at {self._kept[at].decision}"
        # An end before it may be lost, too: it is answered once however often it is sent.
        return first - 1 if first == at and first > 0 and self._kept[first - 1].name == "EndEpisode" else first

    async def _try(self, sent):
        replicas = random.sample(range(len(self._stubs.calls)), 2 if self._hedges else 1)
        tasks = [asyncio.create_task(self._call(replica, sent)) for replica in replicas]
        pending = set(tasks)
        while pending:
            done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
            answered = [task for task in done if task.exception() is None]
            if answered:
                self._compare_later([*answered[1:], *pending], sent)
                return answered[0].result()
        errors = [task.exception() for task in tasks]
        known = [error for error in errors if error.code() != grpc.StatusCode.NOT_FOUND]
        raise next((error for error in known if details_of(error).expected_decision is not None), [*known, *errors][0])

    async def _call(self, replica, sent):
        answer = await self._stubs.calls[replica][sent.name](sent.message, timeout=self._stubs.timeout)
        return answer, self._stubs.addresses[replica]

    def _forget(self, late):
        if late.cancelled() or late.exception() is None:  # the connections are closed, or the answers are equal
            self._late.discard(late)

    def _compare_later(self, tasks, sent):
        async def compare(task):
            try:
                answer, _ = await task
            except grpc.aio.AioRpcError:
                return  # the other replica has answered
            sent.take(answer)

        for task in tasks:
            late = asyncio.create_task(compare(task))
            self._late.add(late)
            late.add_done_callback(self._forget)
