"""`ServerSession`: the session of a pilot at the server, and the engine that plays it too."""

from __future__ import annotations

import contextlib
import logging
from typing import Any

import grpc

from spikeserve.calls import Call, Opened, open_session
from spikeserve.connection import Connection
from spikeserve.errors import SpikeserveError, is_retryable, make_error
from spikeserve.lines import LONGEST_SECONDS
from spikeserve.piloting.datagram_link import ciphers
from spikeserve.piloting.local_engine import LocalEngine, is_wanted
from spikeserve.piloting.pilot_options import PilotOptions
from spikeserve.piloting.robot_messages import robot, to_robot
from spikeserve.replicas import Route
from spikeserve.values import Opening
from spikeserve.wire import METHODS, Message

LOGGER = logging.getLogger("spikeserve.pilot")


class ServerSession:
    """Describes the calls of the session. For one thread, but `session_id`.

    The constructor opens the session, with the retries of the client, and raises SpikeserveError.
    """

    def __init__(
        self, client: Connection, policy: str, options: PilotOptions, route: Route
    ) -> None:
        self._client = client
        self._policy = policy
        self._options = options
        self._route = route
        self.engine = LocalEngine(options.local_policy) if is_wanted(options) else None
        self.sends_datagrams = options.transport != "stream" and ciphers is not None
        self._call: Call[tuple[Opened, Message]] | None = None
        opened, response = client.run(self.opening_call())
        self.opening: Opening = opened.opening
        self.order = opened.order
        self.neutral = self._neutral(response.neutral_action)
        self.take(opened, response)

    def opening_call(self) -> Call[tuple[Opened, Message]]:
        """Describes OpenSession, with the same id until it is answered."""
        self._route.is_pinned = False
        if self._call is None:
            call = open_session(self._policy, self._options.session, self._route)
            call.request.period_seconds = self._options.period
            call.request.datagrams = self.sends_datagrams

            def decode(response: Message) -> tuple[Opened, Message]:
                check_release(response)
                return call.decode(response), response

            self._call = Call(call.method, call.request, decode, route=self._route)
        return self._call

    def take(self, opened: Opened, response: Message) -> None:
        """Takes the answer to OpenSession: the next session is another one."""
        self._call = None
        self.session_id = opened.session_id
        self.response = response
        self.history_limit = int(response.history_limit)
        self.is_stored = opened.opening.durability in ("ASYNC", "SYNC")
        self._route.is_pinned = not self.is_stored

    def call(self, method: str, **fields: Any) -> Call[Message]:
        """Describes another call of the session."""
        request = METHODS[method].request(session_id=self.session_id, **fields)
        return Call(method, request, lambda response: response, route=self._route)

    def export_call(self) -> Call[Message]:
        """Describes ExportSession, for the engine."""
        needs_policy = self.engine is not None and self.engine.needs_policy
        return self.call("ExportSession", include_policy=needs_policy)

    def machine(self, now: int, robot_now: int) -> Any:
        """Returns the state machine of the robot's end.

        Brings the session to the engine. Without the server, the machine tries again later.
        """
        if self._options.transport == "datagram" and not self.response.HasField("datagrams"):
            raise make_error(
                "OpenSession",
                grpc.StatusCode.FAILED_PRECONDITION,
                "transport: expected auto or stream, because the server takes no datagrams, "
                "received datagram",
            )
        export = self._resume()
        options, space = self._options, self.opening.action_space
        learning = options.session.learning
        machine = robot.RobotSession(
            self.neutral,
            neutral_text=str(self.neutral if options.neutral is None else options.neutral),
            n=getattr(space, "n", 0),
            low=getattr(space, "low", ()),
            high=getattr(space, "high", ()),
            observation_size=self.opening.observation_size,
            period=nanoseconds(options.period),
            oldest=nanoseconds(options.oldest),
            oldest_held=nanoseconds(options.oldest_held),
            hold_steps=options.hold_beats,
            ramp_steps=options.ramp,
            most_in_flight=options.most_in_flight,
            kept_steps=options.kept_beats,
            servers=len(self._client.replicas),
            has_engine=self.engine is not None,
            shares_head=learning is not None and learning.scope == "FLEET",
            sends_datagrams=self.sends_datagrams,
            redundancy=options.redundancy,
            history_limit=self.history_limit,
            is_stored=self.is_stored,
            steady=now,
            robot=robot_now,
        )
        if export is not None:
            machine.on_exported(export.decision, export.episode, export.step, now)
        return machine

    def close(self) -> None:
        """Closes the session at the server, if that takes no time."""
        call = self.call("CloseSession")
        with contextlib.suppress(SpikeserveError, ValueError):
            self._client.run(Call(call.method, call.request, call.decode, 1.0, route=self._route))

    def _neutral(self, of_policy: Message) -> Any:
        space = self.opening.action_space
        if self._options.neutral is not None:
            return to_robot(self._options.neutral, space, self.order)
        is_index = of_policy.WhichOneof("kind") != "continuous"
        return to_robot(of_policy.discrete if is_index else of_policy.continuous.values, space)

    def _resume(self) -> Message | None:
        """Brings the session to the engine, or plays without one unless it is required."""
        if self.engine is None:
            return None
        try:
            export = self._client.run(self.export_call())
            self.engine.resume(export)
        except (OSError, ValueError, RuntimeError, SpikeserveError) as error:
            if isinstance(error, SpikeserveError) and is_retryable(error):
                return None
            if self._options.local:
                raise
            LOGGER.warning("the engine on the robot is not used: %s", error)
            self.engine = None
            return None
        return export


def check_release(response: Message) -> None:
    """Raises UnimplementedError if the server that has opened a session appends no beats."""
    if response.history_limit == 0:
        raise make_error(
            "OpenSession",
            grpc.StatusCode.UNIMPLEMENTED,
            "server: expected a release that appends beats, received an older one",
        )


def nanoseconds(seconds: float) -> int:
    """Returns seconds as the machine takes them."""
    return round(min(seconds, LONGEST_SECONDS) * 1e9)
