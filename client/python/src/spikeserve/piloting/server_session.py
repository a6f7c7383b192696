"""`ServerSession`: the session of a pilot at the server, and its copy on the robot."""

from __future__ import annotations

import contextlib
import logging
import pathlib
from typing import Any

import grpc

from spikeserve.calls import Call, Opened, open_session
from spikeserve.connection import Connection
from spikeserve.errors import NotFoundError, SpikeserveError, make_error
from spikeserve.piloting.local_copy import LocalCopy, is_wanted
from spikeserve.piloting.pilot_options import PilotOptions
from spikeserve.stream_opener import StreamOpener
from spikeserve.values import Opening
from spikeserve.wire import METHODS, Message

LOGGER = logging.getLogger("spikeserve.pilot")
_TIMEOUT = 2.0  # seconds for a call; the link makes it again

# Errors of a session that no further request can heal.
_LOST = (
    grpc.StatusCode.NOT_FOUND,
    grpc.StatusCode.FAILED_PRECONDITION,
    grpc.StatusCode.INVALID_ARGUMENT,
    grpc.StatusCode.DATA_LOSS,
)


def is_lost(error: SpikeserveError) -> bool:
    """Returns whether a session is given up after an error of one of its requests."""
    return error.code in _LOST


class ServerSession:
    """Opens the session and brings its value to the robot's engine. For one thread.

    The constructor opens it, with the retries of the client, and raises SpikeserveError.
    """

    def __init__(self, client: Connection, policy: str, options: PilotOptions) -> None:
        self._client = client
        self._policy = policy
        self._options = options
        self.opener = StreamOpener(client)
        self.local = LocalCopy(options.kept_beats) if is_wanted(options) else None
        self._local_failed = False
        self._wants_export = self.local is not None
        self._call: Call[tuple[Opened, Message]] | None = None
        self.is_open = False
        opened, response = client.run(self._opening(None))
        self.opening: Opening = opened.opening
        self.order = opened.order
        self.neutral = response.neutral_action
        self._begin(opened, response)
        if self.history_limit == 0:
            raise make_error(
                "OpenSession",
                grpc.StatusCode.UNIMPLEMENTED,
                "server: expected a release that appends beats, received an older one",
            )
        if self._wants_export:
            with contextlib.suppress(SpikeserveError):  # the link tries again
                self._export()

    @property
    def wants_export(self) -> bool:
        """Returns whether the engine on the robot needs the session's value."""
        is_broken = self.local is not None and self.local.is_broken
        return (self._wants_export or is_broken) and not self._local_failed

    @property
    def local_is_behind(self) -> bool:
        """Returns whether the engine on the robot has beats to play."""
        return self.local is not None and self.local.is_behind

    @property
    def has_local(self) -> bool:
        """Returns whether the engine on the robot can decide."""
        return self.local is not None and self.local.is_ready

    @property
    def shares_head(self) -> bool:
        """Returns whether the session learns the shared head of its fleet."""
        learning = self._options.session.learning
        return learning is not None and learning.scope == "FLEET"

    def open(self) -> None:
        """Opens the session if it is not open; otherwise brings its value to the robot."""
        if not self.is_open:
            self.opener.route.is_pinned = False
            self._call = self._call or self._opening(_TIMEOUT)
            opened, response = self._client.run(self._call)
            self._call = None
            self._begin(opened, response)
        elif self.wants_export:
            self._export()

    def lose(self) -> None:
        """Notes that the server does not have the session any more."""
        self.is_open = False
        self._wants_export = self.local is not None

    def episode_ended(self) -> None:
        """Notes that the server has ended an episode. A shared head may be another one now."""
        self._wants_export = self._wants_export or (self.has_local and self.shares_head)

    def catch_up(self) -> None:
        """Lets the engine on the robot play the beats that it has not played."""
        if self.local is not None:
            self.local.catch_up()

    def close(self) -> None:
        """Closes the session at the server, if that takes no time."""
        if not self.is_open:
            return
        request = METHODS["CloseSession"].request(session_id=self.session_id)
        call = Call("CloseSession", request, lambda _: None, 1.0, route=self.opener.route)
        with contextlib.suppress(SpikeserveError, ValueError):
            self._client.run(call)

    def _opening(self, timeout: float | None) -> Call[tuple[Opened, Message]]:
        call = open_session(self._policy, self._options.session, self.opener.route)
        call.request.period_seconds = self._options.period

        def decode(response: Message) -> tuple[Opened, Message]:
            return call.decode(response), response

        return Call(call.method, call.request, decode, timeout, route=call.route)

    def _begin(self, opened: Opened, response: Message) -> None:
        self.session_id = opened.session_id
        self.history_limit = int(response.history_limit)
        is_stored = opened.opening.durability in ("ASYNC", "SYNC")
        self.is_stored = is_stored
        # EndEpisode waits for the head of a fleet that a store keeps, and the stream does not.
        self.waits_for_merge = is_stored and self.shares_head
        self.opener.route.is_pinned = not is_stored
        self.is_open = True

    def _export(self) -> None:
        """Opens the copy on the robot. Fails for good if the engine or the policy is not here."""
        assert self.local is not None
        fields: dict[str, Any] = {"session_id": self.session_id}
        request = METHODS["ExportSession"].request(**fields)
        wants_policy = self._options.local_policy is None
        if wants_policy and "include_policy" in request.DESCRIPTOR.fields_by_name:
            request.include_policy = True
        call: Call[Message] = Call(
            "ExportSession",
            request,
            lambda response: response,
            _TIMEOUT,
            session_id=self.session_id,
            route=self.opener.route,
        )
        try:
            export = self._client.run(call)
            self.local.open(export, self._policy_of(export))
        except (OSError, ValueError, RuntimeError) as error:
            self._fail_local(str(error))
        except SpikeserveError as error:
            if error.code in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.DEADLINE_EXCEEDED):
                raise
            if isinstance(error, NotFoundError):
                raise
            self._fail_local(str(error))
        self._wants_export = False

    def _policy_of(self, export: Message) -> pathlib.Path | bytes:
        given = self._options.local_policy
        if given is None:
            content = bytes(getattr(export, "policy_file", b""))
            if not content:
                raise ValueError("local_policy: expected the policy file, received none")
            return content
        path = pathlib.Path(given)
        if path.is_dir():
            path = path / export.policy / str(export.version) / "policy.safetensors"
        return path

    def _fail_local(self, reason: str) -> None:
        self._local_failed = True
        if self._options.local:
            raise ValueError(reason)
        LOGGER.warning("the engine on the robot is not used: %s", reason)
