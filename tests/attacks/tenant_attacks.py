"""Attacks of those who have a token: on memory, on the time of the event loops, and on roll-outs.

The attacker's token is that of the tenant "fleet"; the neighbour belongs to another.
"""

import concurrent.futures
import contextlib
import itertools
import time

import grpc
from contract import call, v1
from security import OBSERVATION, POLICY

from tests.attacks import frames
from tests.attacks.flood import PAUSE, Sent, flood
from tests.attacks.http2_attacks import OPENING
from tests.attacks.slow_attacks import call_headers

TOKEN = ("authorization", "Bearer agent")
ITEMS = 1024
BATCHES = 50  # in one burst of a connection
LISTERS = 6
RECORDERS = 4
SESSIONS = 12
STEPS = 1000
WORST = -1e6  # a return
EPISODES = 40
CALL_SECONDS = 30
RUNNING = 1  # Rollout.STATE_RUNNING


def requests_of(method, message, burst):
    """Returns a script that calls a method with one message, in bursts with a pause after each."""

    def script():
        yield OPENING
        data = frames.framed(message)
        for first in itertools.count(0, burst):
            yield b"".join(
                call_headers(frames.POLICY + method, stream, TOKEN)
                + frames.frame(frames.DATA, data, frames.END_STREAM, stream)
                for stream in frames.streams(first, burst)
            )
            yield PAUSE

    return script


def batches_of_empty_items(address, seconds):
    """Sends batches of 1,024 empty requests, 2 KB each, on 20 connections."""
    return flood(address, seconds, requests_of("ActBatch", b"\n\0" * ITEMS, BATCHES), 20)


def batches_of_short_items(address, seconds):
    """Sends batches of 1,024 requests for a session that does not exist, 5 KB each, on 20 connections."""
    items = b"\n\x03\n\x01x" * ITEMS
    return flood(address, seconds, requests_of("ActBatch", items, BATCHES), 20)


def batches_that_nobody_reads(address, seconds):
    """As above, and reads no answers."""
    items = b"\n\x03\n\x01x" * ITEMS
    script = requests_of("ActBatch", items, BATCHES)
    return flood(address, seconds, script, connections=20, read=False)


def policy_lists(address, seconds):
    """Asks for the list of policies again and again, on six connections."""
    return flood(address, seconds, requests_of("ListPolicies", b"", 4), LISTERS)


def connections_of_many_addresses(address, seconds):
    """Holds 10,300 connections, each from another address and with one call that is refused."""
    refused = call_headers(frames.POLICY + "GetSession", 1, ("authorization", "Bearer wrong"))
    opening = OPENING + refused + frames.frame(frames.DATA, frames.framed(b""), frames.END_STREAM, 1)
    sources = (f"127.{1 + i // 62500 % 250}.{i // 250 % 250}.{1 + i % 250}" for i in itertools.count())
    return flood(
        address, seconds, lambda: iter([opening]), connections=10_300, source=lambda: next(sources)
    )


EXPORTERS = 6
LONG_ID = 60_000  # bytes


def exports_of_long_ids(address, seconds):
    """Exports sessions whose ids are long, each of which is recorded. An operator acts in the end."""
    message = v1("ExportSessionRequest", session_id="x" * LONG_ID).SerializeToString()
    sent = flood(address, seconds, requests_of("ExportSession", message, 4), EXPORTERS)
    with grpc.insecure_channel(f"{address[0]}:{address[1]}") as channel:
        label = v1("SetLabelRequest", policy="cartpole", version=1, label="after")
        Agents(channel, sent)("/spikeserve.v1.PolicyAdmin/SetLabel", label, "machine")
    return sent


def recordings_of_one_tenant(address, seconds):
    """Records episodes of one step, as many as one tenant can."""
    sent = Sent(connections=1)
    end = time.monotonic() + seconds
    with grpc.insecure_channel(f"{address[0]}:{address[1]}") as channel:
        agents = Agents(channel, sent)
        opening = v1("OpenSessionRequest", policy="cartpole", record=True)

        def record():
            session = agents(f"/{POLICY}/OpenSession", opening).session_id
            while time.monotonic() < end:
                agents.episode(session, OBSERVATION, 1.0)

        with concurrent.futures.ThreadPoolExecutor(RECORDERS) as threads:
            for done in [threads.submit(record) for _ in range(RECORDERS)]:
                done.result()
    return sent


def histories_of_many_sessions(address, seconds):
    """Sends histories of 1,000 steps in twelve sessions, which the server has to compute."""
    sent = Sent(connections=1)
    end = time.monotonic() + seconds
    with grpc.insecure_channel(f"{address[0]}:{address[1]}") as channel:
        agents = Agents(channel, sent)

        def play():
            session = agents(f"/{POLICY}/OpenSession", v1("OpenSessionRequest", policy="cartpole")).session_id
            decision = 0
            while time.monotonic() < end:
                first = v1("ActRequest", session_id=session, decision=decision, observation=OBSERVATION)
                executed = {"discrete": agents(f"/{POLICY}/Act", first).action.discrete}
                beats = [
                    v1("Beat", step=step, observation=OBSERVATION, executed=executed)
                    for step in range(STEPS)
                ]
                request = v1("ActRequest", session_id=session, step=STEPS, decision=decision + STEPS)
                request.observation.extend(OBSERVATION)
                request.history.extend(beats)
                agents(f"/{POLICY}/Act", request)
                agents(f"/{POLICY}/EndEpisode", v1("EndEpisodeRequest", session_id=session))
                decision += STEPS + 1

        with concurrent.futures.ThreadPoolExecutor(SESSIONS) as threads:
            for done in [threads.submit(play) for _ in range(SESSIONS)]:
                done.result()
    return sent


class DecidedRolloutError(Exception):
    """One session has decided a roll-out for all tenants."""


class Agents:
    """Calls of an agent and of an operator over one channel, which counts what it sends."""

    def __init__(self, channel, sent):
        self._channel = channel
        self._sent = sent

    def __call__(self, path, request, token="agent"):
        self._sent.bytes += request.ByteSize()
        metadata = (("authorization", f"Bearer {token}"),)
        return call(self._channel, path)(request, metadata=metadata, timeout=CALL_SECONDS)

    def episode(self, session, observation, reward):
        """Plays an episode of one step."""
        act = v1("ActRequest", session_id=session, step=0, observation=observation)
        with contextlib.suppress(grpc.RpcError):  # a wrong size is refused
            self(f"/{POLICY}/Act", act)
            self(f"/{POLICY}/EndEpisode", v1("EndEpisodeRequest", session_id=session, reward=reward))


def rollout_decided_by_one_agent(address, seconds):
    """Ends bad episodes, and sends observations of a wrong size, in one session of a roll-out that is running."""
    sent = Sent(connections=1)
    admin = "/spikeserve.v1.PolicyAdmin"
    end = time.monotonic() + seconds
    with grpc.insecure_channel(f"{address[0]}:{address[1]}") as channel:
        agents = Agents(channel, sent)
        start = v1("StartRolloutRequest", policy="cartpole", version=1, steps=[50, 100])
        agents(f"{admin}/StartRollout", start, "machine")

        def check():
            listed = agents(f"{admin}/ListRollouts", v1("ListRolloutsRequest"), "machine")
            (rollout,) = [r for r in listed.rollouts if r.policy == "cartpole"]
            if rollout.state != RUNNING:
                raise DecidedRolloutError(rollout.reason)

        while time.monotonic() < end:
            opened = v1("OpenSessionRequest", policy="cartpole", version=1)
            session = agents(f"/{POLICY}/OpenSession", opened).session_id
            for _ in range(EPISODES):
                agents.episode(session, OBSERVATION, WORST)
                agents.episode(session, [0.0], WORST)
            check()
        time.sleep(0.5)  # the judge looks five times a second
        check()
    return sent
