"""`Link`: the thread and the calls around the robot's state machine, which decides everything.

The background thread does what the machine wants, again and again, without waiting for a server:
calls have threads of their own, and replies arrive on those of the stream and of the datagrams.
Control steps send their requests by themselves, while there is a way.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable, Mapping
from concurrent.futures import Future
from dataclasses import replace
from typing import Any

from spikeserve.calls import Call
from spikeserve.connection import Connection
from spikeserve.errors import SpikeserveError
from spikeserve.piloting import robot_clock
from spikeserve.piloting.datagram_link import DatagramLink
from spikeserve.piloting.pilot_options import PilotOptions
from spikeserve.piloting.robot_messages import (
    error_to_robot,
    lost_episode,
    return_of,
    robot,
    take_reply,
    to_robot,
)
from spikeserve.piloting.server_session import ServerSession, nanoseconds
from spikeserve.replicas import Replica
from spikeserve.stream_call import StreamCall
from spikeserve.stream_opener import StreamOpener
from spikeserve.values import EpisodeSummary
from spikeserve.wire import METHODS, Message

LOGGER = logging.getLogger("spikeserve.pilot")
CALL_SECONDS = 2.0  # for a call; the machine makes it again
# Control steps wake the background thread only for the engine on the robot. So it looks at the
# machine at least this often: for requests that wait for too long, and for what is to be logged.
LOOK_SECONDS = 0.1
_CLOSED = "the pilot was closed before the server had the end of the episode"


class Link:
    """Thread-safe. `changed` guards the machine, and is notified when a step may go on."""

    def __init__(
        self,
        client: Connection,
        options: PilotOptions,
        opener: StreamOpener,
        session: ServerSession,
    ) -> None:
        self.changed = threading.Condition()
        self.machine = session.machine(time.monotonic_ns(), robot_clock.now_ns())
        self.engine = session.engine
        self._client = client
        self._oldest = nanoseconds(options.oldest)
        self._opener = opener
        self._session = session
        self._servers: list[Replica] = list(client.replicas)
        self._stream: StreamCall | None = None
        self._datagrams = DatagramLink(self._on_datagram) if session.sends_datagrams else None
        self._take_channel(session.response)
        self._call: Call[Any] | None = None  # one at a time
        self._ended: list[tuple[Call[Any], Replica, Any]] = []  # calls, and what became of them
        self._summaries: dict[int, Future[EpisodeSummary]] = {}  # by serial number
        self._woken = threading.Event()
        self._thread = threading.Thread(target=self._run, name="spikeserve-pilot", daemon=True)

    def start(self) -> None:
        """Starts the background thread."""
        self._thread.start()

    def close(self, timeout: float) -> None:
        """Ends the background thread, after the ends of episodes have reached the server."""
        with self.changed:
            self.machine.close(time.monotonic_ns() + nanoseconds(timeout))
        self._woken.set()
        if self._thread.ident is not None:
            self._thread.join()

    # For the robot's thread, with `changed` held.

    def send(self) -> None:
        """Sends what may be sent now, and lets the engine on the robot play."""
        while (task := self.machine.next_send(time.monotonic_ns())) is not None:
            self._send(task)
        if self.engine is not None:
            self._woken.set()

    def await_end(self, serial: int, summary: Future[EpisodeSummary]) -> None:
        """Lets an ended episode complete `summary`."""
        self._summaries[serial] = summary
        self.send()
        self._woken.set()

    def _send(self, task: Any) -> None:
        request = METHODS["Act"].request(session_id=self._session.session_id, **task.request)
        if request.HasField("observed_at"):
            request.valid_until = request.observed_at + self._oldest
        if task.copies > 0:
            assert self._datagrams is not None
            self._datagrams.send(task.datagram, request, task.copies)
        if task.by_stream:
            assert self._stream is not None
            self._stream.send(request)

    def _take_channel(self, message: Message) -> None:
        """Sends on the channel of an answer from now on, if it brings one."""
        if self._datagrams is None or not message.HasField("datagrams"):
            return
        if self._datagrams.set_channel(message.datagrams):
            life = nanoseconds(message.datagrams.valid_seconds)
            self.machine.on_channel(time.monotonic_ns() + life)

    # The background thread.

    def _run(self) -> None:
        while self._work():
            pass
        self._stop()

    def _work(self) -> bool:
        """Does the next thing, or waits. Returns False if the robot has closed the session."""
        self._woken.clear()
        with self.changed:
            ended, self._ended = self._ended, []
            task = self.machine.next(time.monotonic_ns()) if not ended else None
            if task is not None and task.kind is robot.Kind.SEND:
                self._send(task)
            lines = self.machine.take_lines()
        _write_log(lines)
        try:
            for each in ended:
                self._take_call(*each)
            if task is not None:
                self._do(task)
        except Exception:
            LOGGER.exception("the link to the server failed")
            self._woken.wait(LOOK_SECONDS)
        return task is None or task.kind is not robot.Kind.STOP

    def _do(self, task: Any) -> None:
        kinds = robot.Kind
        if task.kind is kinds.WAIT:
            left = (task.time - time.monotonic_ns()) / 1e9
            self._woken.wait(max(0.0, min(left, LOOK_SECONDS)))
        elif task.kind is kinds.FORGET:
            self._forget(task.serial, task.reason)
        elif task.kind is kinds.PLAY:
            self._play()
        elif task.kind is kinds.OPEN_STREAM:
            self._open_stream()
        elif task.kind is kinds.CLOSE_STREAM:
            self._close_stream()
        elif task.kind is kinds.DOUBT_LINE:
            self._opener.suspect(task.time / 1e9)
        elif task.kind is kinds.OPEN_SESSION:
            self._begin(self._session.opening_call())
        elif task.kind is kinds.EXPORT_SESSION:
            self._begin(self._session.export_call())
        elif task.kind is kinds.END_EPISODE:
            with self.changed:
                fields = self.machine.end_fields()
            self._begin(self._session.call("EndEpisode", **fields))

    def _forget(self, serial: int, reason: str) -> None:
        self._cancel_stream()
        with self.changed:
            if not self.machine.is_calling():
                self._call = None
        self._fail_summaries(serial, reason)

    def _open_stream(self) -> None:
        with self.changed:
            denied = [s for i, s in enumerate(self._servers) if self.machine.has_denied(i)]
        server = self._client.replicas.choose(self._opener.route, denied)

        def open_call(requests: Iterable[Message]) -> Any:
            return self._opener.open(requests, at=server)

        stream = StreamCall(open_call, self._on_reply, self._on_end)
        with self.changed:
            self._stream = stream
            self.machine.on_stream_opened(self._servers.index(server))
        try:
            stream.start()
        except ValueError as error:  # its channel was closed meanwhile
            with self.changed:
                self.machine.on_stream_ended(error_to_robot(error))

    def _close_stream(self) -> None:
        is_renewed = self._opener.is_renewed
        self._cancel_stream()
        with self.changed:
            has_failed = self.machine.on_stream_closed(is_renewed, time.monotonic_ns())
        if has_failed:
            self._opener.failed()

    def _cancel_stream(self) -> None:
        with self.changed:
            stream, self._stream = self._stream, None
        if stream is not None:
            stream.cancel()

    def _play(self) -> None:
        assert self.engine is not None
        with self.changed:
            work = self.machine.work()
        action, text = None, ""
        try:
            action = to_robot(self.engine.play(work), self._session.opening.action_space)
        except Exception as error:
            text = str(error)
        with self.changed:
            self.machine.on_played(action, text, time.monotonic_ns())
            self.changed.notify_all()

    def _begin(self, call: Call[Any]) -> None:
        self._call = call
        server = self._client.replicas.choose(call.route)

        def run() -> None:
            result: Any
            try:
                result = self._client.run_once(call, server, CALL_SECONDS)
            except Exception as error:
                result = error
            with self.changed:
                self._ended.append((call, server, result))
            self._woken.set()

        threading.Thread(target=run, name="spikeserve-pilot-call", daemon=True).start()

    def _take_call(self, call: Call[Any], server: Replica, result: Any) -> None:
        """Passes on what became of a call."""
        if call is not self._call:
            return  # of a session that is lost
        self._call = None
        if call.method == "ExportSession" and not isinstance(result, Exception):
            assert self.engine is not None
            try:
                self.engine.resume(result)  # takes a moment to read the policy
            except Exception as error:
                result = error
        with self.changed:
            now = time.monotonic_ns()
            if isinstance(result, Exception):
                place = self._servers.index(server), now
                self.machine.on_call_failed(error_to_robot(result), *place)
                return
            if call.method == "OpenSession":
                self._session.take(*result)
                self.machine.on_opened(self._session.history_limit, self._session.is_stored)
                self._take_channel(self._session.response)
                return
            if call.method == "ExportSession":
                self.machine.on_exported(result.decision, result.episode, result.step, now)
                return
            settled = self.machine.on_episode_ended(return_of(result))
        self._complete(settled, result)

    def _stop(self) -> None:
        with self.changed:
            is_open = self.machine.stop()
            self._call = None
        self._cancel_stream()
        if self._datagrams is not None:
            self._datagrams.stop()
        self._fail_summaries(None, _CLOSED)
        with self.changed:
            lines = self.machine.take_lines()
        _write_log(lines)
        if is_open:
            self._session.close()

    # On the thread of the stream.

    def _on_reply(self, stream: StreamCall, reply: Message) -> None:
        self._take(reply, stream=stream)

    def _on_end(self, stream: StreamCall, error: SpikeserveError) -> None:
        with self.changed:
            if stream is self._stream:
                self.machine.on_stream_ended(error_to_robot(error))
                self.changed.notify_all()
        self._woken.set()

    # On the thread of the datagrams.

    def _on_datagram(self, number: int, reply: Message) -> None:
        self._take(reply, number=number)

    # On both.

    def _take(
        self, reply: Message, *, stream: StreamCall | None = None, number: int | None = None
    ) -> None:
        """Takes an answer: of a stream, unless another one has its place, or of a datagram."""
        now, robot_now = time.monotonic_ns(), robot_clock.now_ns()
        with self.changed:
            if stream is not None:
                if stream is not self._stream:
                    return
                self._opener.answered()
            settled, has_work = take_reply(self.machine, reply, now, robot_now, number)
            self._take_channel(reply)
            self.changed.notify_all()
        if has_work:
            self._woken.set()
        if settled is not None:
            self._complete(settled, reply.ended)

    # On both, and the background thread.

    def _complete(self, settled: tuple[int, Mapping[str, Any]], ended: Message) -> None:
        """Gives the summary of an episode to those who wait for it, if somebody does."""
        serial, own = settled
        with self.changed:
            summary = self._summaries.pop(serial, None)
        if summary is not None:
            summary.set_result(replace(EpisodeSummary.from_wire(ended), **own))

    def _fail_summaries(self, serial: int | None, reason: str) -> None:
        """Gives up the summaries of the episodes before `serial`, or all."""
        with self.changed:
            lost = [each for each in self._summaries if serial is None or each < serial]
            summaries = [self._summaries.pop(each) for each in lost]
        for summary in summaries:
            summary.set_exception(lost_episode(reason))


def _write_log(lines: Iterable[str]) -> None:
    for line in lines:
        is_good = line.startswith(("fresh after", "held after"))
        LOGGER.log(logging.INFO if is_good else logging.WARNING, "%s", line)
