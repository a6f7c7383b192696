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
REPORTERS = 4
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


class Agents:
    """Calls of an agent and of an operator over one channel, which counts what it sends."""

    def __init__(self, channel, sent):
        self._channel = channel
        self.sent = sent

    def __call__(self, path, request, token="agent"):
        self.sent.bytes += request.ByteSize()
        metadata = (("authorization", f"Bearer {token}"),)
        return call(self._channel, path)(request, metadata=metadata, timeout=CALL_SECONDS)

    def open(self, **fields):
        """Opens a session. Returns its id."""
        return self(f"/{POLICY}/OpenSession", v1("OpenSessionRequest", policy="cartpole", **fields)).session_id

    def episode(self, session, observation, reward):
        """Plays an episode of one step."""
        act = v1("ActRequest", session_id=session, step=0, observation=observation)
        with contextlib.suppress(grpc.RpcError):  # a wrong size is refused
            self(f"/{POLICY}/Act", act)
            self(f"/{POLICY}/EndEpisode", v1("EndEpisodeRequest", session_id=session, reward=reward))


@contextlib.contextmanager
def calling(address, sent=None):
    """Yields Agents with a connection."""
    with grpc.insecure_channel(f"{address[0]}:{address[1]}") as channel:
        yield Agents(channel, sent or Sent(connections=1))


def in_threads(count, seconds, work):
    """Calls work(is_over) in `count` threads; is_over() becomes true after `seconds`."""
    end = time.monotonic() + seconds
    with concurrent.futures.ThreadPoolExecutor(count) as threads:
        for done in [threads.submit(work, lambda: time.monotonic() >= end) for _ in range(count)]:
            done.result()


def exports_of_long_ids(address, seconds):
    """Exports sessions whose ids are long, each of which is recorded. An operator acts in the end."""
    message = v1("ExportSessionRequest", session_id="x" * LONG_ID).SerializeToString()
    sent = flood(address, seconds, requests_of("ExportSession", message, 4), EXPORTERS)
    with calling(address, sent) as agents:
        label = v1("SetLabelRequest", policy="cartpole", version=1, label="after")
        agents("/spikeserve.v1.PolicyAdmin/SetLabel", label, "machine")
    return sent


def recordings_of_one_tenant(address, seconds):
    """Records episodes of one step, as many as one tenant can."""
    with calling(address) as agents:

        def record(is_over):
            session = agents.open(record=True)
            while not is_over():
                agents.episode(session, OBSERVATION, 1.0)

        in_threads(RECORDERS, seconds, record)
    return agents.sent


def histories_of_many_sessions(address, seconds):
    """Sends histories of 1,000 steps in twelve sessions, which the server has to compute."""
    with calling(address) as agents:

        def play(is_over):
            session = agents.open()
            decision = 0
            while not is_over():
                first = v1("ActRequest", session_id=session, decision=decision, observation=OBSERVATION)
                executed = {"discrete": agents(f"/{POLICY}/Act", first).action.discrete}
                beats = [{"step": step, "observation": OBSERVATION, "executed": executed} for step in range(STEPS)]
                request = v1(
                    "ActRequest",
                    session_id=session,
                    step=STEPS,
                    decision=decision + STEPS,
                    observation=OBSERVATION,
                    history=beats,
                )
                agents(f"/{POLICY}/Act", request)
                agents(f"/{POLICY}/EndEpisode", v1("EndEpisodeRequest", session_id=session))
                decision += STEPS + 1

        in_threads(SESSIONS, seconds, play)
    return agents.sent


def reports_that_no_robot_makes(address, seconds):
    """Reports counts and returns that would fill the sums of all tenants. Half of them are refused by their form."""
    with calling(address) as agents:

        def play(is_over):
            session = agents.open()
            for step in itertools.count():
                if is_over():
                    return
                beats = {"safe": 10**12 - 1 if step % 2 else 2**64 - 1, "longest_gap_seconds": 1e7}
                act = v1("ActRequest", session_id=session, step=step // 2, observation=OBSERVATION, report=beats, reward=WORST)
                with contextlib.suppress(grpc.RpcError):
                    agents(f"/{POLICY}/Act", act)

        in_threads(REPORTERS, seconds, play)
    return agents.sent


class DecidedRolloutError(Exception):
    """One session has decided a roll-out for all tenants."""


def rollout_decided_by_one_agent(address, seconds):
    """Ends bad episodes, and sends observations of a wrong size, in one session of a roll-out that is running."""
    admin = "/spikeserve.v1.PolicyAdmin"
    with calling(address) as agents:
        start = v1("StartRolloutRequest", policy="cartpole", version=1, steps=[50, 100])
        with contextlib.suppress(grpc.RpcError):  # it is running since the round before
            agents(f"{admin}/StartRollout", start, "machine")

        def check():
            listed = agents(f"{admin}/ListRollouts", v1("ListRolloutsRequest"), "machine")
            (rollout,) = [r for r in listed.rollouts if r.policy == "cartpole"]
            if rollout.state != RUNNING:
                raise DecidedRolloutError(rollout.reason)

        def play(is_over):
            while not is_over():
                session = agents.open(version=1)
                for _ in range(EPISODES):
                    agents.episode(session, OBSERVATION, WORST)
                    agents.episode(session, [0.0], WORST)
                check()

        in_threads(1, seconds, play)
        time.sleep(0.5)  # the judge looks five times a second
        check()
    return agents.sent
