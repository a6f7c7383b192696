"""`Link`: brings the beats of a robot to the server, and the answers back.

One background thread does everything that may take time. It looks at the state (is there a session,
a stream, an episode that has ended?) and does the first thing that is missing, again and again, so
that no event can be lost:

    closing     the pilot was closed, and nothing is left to be told, or its time is over: stop
    no session  open one (OpenSession), and bring it to the robot's engine (ExportSession)
    no stream   open one, after a pause that grows to 0.2 s
    ended       the oldest episode has ended: send the beats of it that the server may miss and its
                end, and the next episode may be asked for; if they are too many for one request,
                send a part of them when no request is under way. A server of an earlier release
                has no ends on streams: when it has all beats, call EndEpisode until it is answered
    silent      requests wait for answers: try a fresh connection, or another server
    idle        wait until a fact changes

Beats and ends of episodes send their requests by themselves, while there is a stream. What fails
changes the state: the end of a stream is "no stream", a lost session "no session", a server that
has lost beats, or the ends of episodes, misses them again.
"""

from __future__ import annotations

import collections
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import grpc
import numpy as np

from spikeserve.calls import Call
from spikeserve.connection import Connection
from spikeserve.errors import (
    InvalidArgumentError,
    NotFoundError,
    SpikeserveError,
    error_of_item,
    expected_decision,
    expected_episode,
    make_error,
)
from spikeserve.lines import SILENCE_SECONDS
from spikeserve.piloting import robot_clock
from spikeserve.piloting.beat_log import BeatLog, Ending, Episode
from spikeserve.piloting.pilot_options import PilotOptions
from spikeserve.piloting.pilot_stats import Counters
from spikeserve.piloting.server_session import ServerSession, is_lost
from spikeserve.piloting.stream_call import StreamCall
from spikeserve.values import Action, EpisodeSummary
from spikeserve.wire import Message

LOGGER = logging.getLogger("spikeserve.pilot")
# A server that takes a session over, or whose store has lost it, may deny it while another one has
# it. A session that a store has is lost when those that answer have denied it for this time.
DENIED_SECONDS = 2.0
FIRST_PAUSE, LONGEST_PAUSE = 0.05, 0.2  # seconds before the next stream or call
GIVE_UP_SECONDS = 1.0  # without an answer, before another server is asked


@dataclass(frozen=True)
class Answer:
    """The server's decision for a beat."""

    episode: Episode
    step: int
    action: Action
    observed_at: int  # of robot_clock.now_ns()
    is_miswired: bool  # the action is the neutral one, because the observations look miswired


@dataclass(frozen=True)
class _Request:
    """A request under way."""

    episode: Episode
    step: int
    sent: float  # time.monotonic()
    ends: bool  # it ends the episode
    asks: bool  # for a decision


class Link:
    """Thread-safe. `changed` guards everything, and is notified when anything changes."""

    def __init__(self, client: Connection, options: PilotOptions, session: ServerSession) -> None:
        self.changed = threading.Condition()
        self.options = options
        self.session = session
        self.log = BeatLog(options.kept_beats, session.opening.observation_size)
        self.counters = Counters(time.monotonic())
        self.answer: Answer | None = None  # the newest one
        self.round_trip: float | None = None  # seconds, smoothed
        self._opener = session.opener
        self._client = client
        self._call: StreamCall | None = None
        self._under_way: collections.deque[_Request] = collections.deque()
        self._window = options.most_in_flight
        self._replied_at = 0.0  # time.monotonic() of the last reply
        self._doubted_at = 0.0
        self._denied_since: float | None = None  # time.monotonic(); None: a server has the session
        self._paused_until = 0.0  # no requests before, as the server asked
        self._next_try = 0.0  # of a call or a stream
        self._pause = FIRST_PAUSE
        self._closes_at: float | None = None  # None: the pilot is open
        self._begun = False  # whether a stream was opened before
        self._ends_on_stream = False  # episodes end there, not by EndEpisode
        self._calls_end = False  # EndEpisode is under way
        self._take_opening()
        self._thread = threading.Thread(target=self._run, name="spikeserve-pilot", daemon=True)

    def start(self) -> None:
        """Starts the background thread."""
        self._thread.start()

    def close(self, timeout: float) -> None:
        """Ends the background thread, after the ends of episodes have reached the server."""
        with self.changed:
            self._closes_at = time.monotonic() + timeout
            self.changed.notify_all()
        if self._thread.ident is not None:
            self._thread.join()

    # Called by beats, with `changed` held.

    def send_newest(self) -> None:
        """Sends the request of the newest beat if it may be sent now.

        A beat without an observation asks for nothing: it only reports, and brings what was before.
        """
        now = time.monotonic()
        self._send_end(now)
        running = self.log.running
        is_news = running.beats[-1].observation is not None or (
            len(running.beats) > 1 and self.counters.is_report_due(now)
        )
        has_room = len(self._under_way) < self._window
        if is_news and self.log.is_current and self._may_send(now) and has_room:
            self._send(running, now)

    @property
    def is_asking(self) -> bool:
        """Returns whether a request waits for its answer."""
        return len(self._under_way) > 0

    def expected_answer(self, deadline: float) -> int | None:
        """Returns the newest step whose answer should arrive before `deadline`; None: none should.

        `deadline` is of time.monotonic().
        """
        for request in reversed(self._under_way):
            if request.episode is not self.log.running:
                return None
            if not request.asks:
                continue
            if self.round_trip is None or request.sent + self.round_trip <= deadline:
                return request.step
        return None

    def end_episode(self, ending: Ending) -> None:
        """Ends the running episode of the robot."""
        self.log.end(ending)
        self.answer = None
        self._send_end(time.monotonic())
        self.changed.notify_all()

    # The background thread.

    def _run(self) -> None:
        while True:
            with self.changed:
                work, wait = self._plan(time.monotonic())
                if work is None:
                    self.changed.wait(wait)
                    continue
            if work == self._stop:
                break
            try:
                work()
            except SpikeserveError as error:
                self._failed(error)
            except Exception:
                LOGGER.exception("the link to the server failed")
                self._pause_tries()
        self._stop()

    def _plan(self, now: float) -> tuple[Callable[[], None] | None, float]:
        """Returns what to do now, or None and how many seconds to wait."""
        oldest = self.log.oldest
        if self._closes_at is not None and (now >= self._closes_at or oldest.ending is None):
            return self._stop, 0.0
        if self.log.is_too_long and self.session.is_open:
            self._lose("the server has missed too many beats")
        if self.session.local_is_behind:
            return self.session.catch_up, 0.0
        until = self._next_try - now
        if not self.session.is_open or self.session.wants_export:
            return (self._open_session, 0.0) if until <= 0 else (None, until)
        if self._call is None:
            return (self._open_stream, 0.0) if until <= 0 else (None, until)
        if oldest.is_complete and not self._ends_on_stream:
            return (self._end_oldest, 0.0) if until <= 0 else (None, until)
        self._send_end(now)
        if oldest.ending is not None and now < self._paused_until:
            return None, self._paused_until - now
        return None, self._doubt(now)

    def _doubt(self, now: float) -> float:
        """Tries a fresh connection if requests wait for too long. Returns the seconds to wait."""
        limit = 1.0 if self._closes_at is None else max(0.01, self._closes_at - now)
        if not self._under_way:
            return limit
        since = max(self._under_way[0].sent, self._replied_at)
        if now - since >= GIVE_UP_SECONDS and self._opener.has_others and self._call is not None:
            self._opener.failed()
            self._end_call()
            return 0.0
        due = max(since, self._doubted_at) + SILENCE_SECONDS
        if now >= due:
            self._doubted_at = now
            self._opener.suspect(since)
            due = now + SILENCE_SECONDS
        return min(limit, due - now)

    def _open_session(self) -> None:
        was_open = self.session.is_open
        self.session.open()
        with self.changed:
            if not was_open:
                self._take_opening()
                self.counters.count(reopened=1)
            self._succeeded()

    def _open_stream(self) -> None:
        call = StreamCall(self._opener.open, self._on_reply, self._on_end)
        with self.changed:
            self._call = call
            self._ends_on_stream = not self.session.waits_for_merge
            self.counters.count(reconnects=int(self._begun))
            self._begun = True
            self._under_way.clear()
        try:
            call.start()
        except BaseException:  # its channel was closed meanwhile
            with self.changed:
                self._call = None
            raise

    def _end_oldest(self) -> None:
        with self.changed:
            request = self.log.oldest.end_request(self.session.session_id)
            self._calls_end = True
        ending = Call(
            "EndEpisode",
            request,
            EpisodeSummary.from_wire,
            timeout=2.0,
            session_id=self.session.session_id,
            route=self._opener.route,
        )
        try:
            summary = self._client.run(ending)
        finally:
            with self.changed:
                self._calls_end = False
        with self.changed:
            ended = self._settle(summary)
            self._succeeded()
        ended.complete(summary)

    def _stop(self) -> None:
        with self.changed:
            call, self._call = self._call, None
            endings = [e.ending for e in self.log.episodes if e.ending is not None]
        if call is not None:
            call.cancel()
        self._fail(endings, "the pilot was closed before the server had the end of the episode")
        self.session.close()

    # Replies, on the thread of the stream.

    def _on_reply(self, call: StreamCall, reply: Message) -> None:
        now, now_ns = time.monotonic(), robot_clock.now_ns()
        ended: Ending | None = None
        with self.changed:
            if call is not self._call or not self._under_way:
                return
            request = self._under_way.popleft()
            self._replied_at = now
            self._opener.answered()
            if reply.HasField("error"):
                self.counters.count(cancelled_calls=1)
                self._refused(error_of_item("ActStream", reply.error), request)
            elif request.episode is self.log.oldest:
                self._succeeded()
                self.log.forget_durable(reply.durable_decision, reply.durable_episode)
                if request.ends and reply.HasField("ended"):
                    summary = EpisodeSummary.from_wire(reply.ended)
                    ended = self._settle(summary)
                else:
                    self._acknowledged(reply, request, now, now_ns)
            self.changed.notify_all()
        if ended is not None:
            ended.complete(summary)

    def _acknowledged(self, reply: Message, request: _Request, now: float, now_ns: int) -> None:
        if request.ends:  # a server of an earlier release has taken the beats, not the end
            self._ends_on_stream = self.log.is_ending = False
        request.episode.acknowledge(reply.next_step)
        if reply.HasField("action"):
            self._take(reply, request, now, now_ns)

    def _settle(self, summary: EpisodeSummary) -> Ending:
        self.session.episode_ended()
        ending = self.log.settle()
        # A server that repeats its answer may know the steps alone: what it decides costs energy.
        if summary.energy_joules > 0 and summary.episode_return != ending.episode_return:
            self.counters.count(unequal_returns=1)
            returns = ending.episode_return, summary.episode_return
            LOGGER.warning("an episode: expected the return %f, received %f", *returns)
        return ending

    def _take(self, reply: Message, request: _Request, now: float, now_ns: int) -> None:
        took = now - request.sent
        before = self.round_trip
        self.round_trip = took if before is None else before + (took - before) / 8
        age = (now_ns - reply.observed_at) / 1e9
        self.counters.count(late_answers=int(age > self.options.period))
        if age > self.options.oldest:
            # More requests would only make the queue longer.
            self._window = max(1, self._window // 2)
            self.counters.count(stale=1)
            return
        self._window = min(self._window + 1, self.options.most_in_flight)
        newest = self.answer
        if newest is None or newest.episode is not request.episode or reply.step > newest.step:
            kind = reply.action.WhichOneof("kind")
            values = reply.action.continuous.values
            action = reply.action.discrete if kind == "discrete" else np.asarray(values, np.float32)
            is_miswired = reply.wiring.is_safe_action
            at = reply.observed_at
            self.answer = Answer(request.episode, reply.step, action, at, is_miswired)

    def _refused(self, error: SpikeserveError, request: _Request) -> None:
        """Handles the error of one request."""
        expected = expected_decision(error)
        oldest = self.log.oldest
        is_oldest = request.episode is oldest
        if request.ends and is_oldest:
            self.log.is_ending = False
        if expected is not None:
            # A request behind an end that failed, or one that was sent twice, fails without
            # consequence.
            if not is_oldest:
                return
            # The server has lost what it had acknowledged, the ends of episodes, too, and gets it
            # again. If it has lost nothing, it has another end of the episode.
            is_kept = self.log.rewind(expected, expected_episode(error))
            if not is_kept or (request.ends and self.log.oldest is oldest and oldest.is_complete):
                self._lose(error.message)
        elif error.retry_after is not None:
            self._paused_until = time.monotonic() + error.retry_after
        elif isinstance(error, NotFoundError) and self._may_be_elsewhere():
            self._log_failure(error)
            self._pause_tries()
            self._end_call()
        elif is_lost(error):
            self._lose(error.message, error)
        else:
            self._log_failure(error)
            self._pause_tries()
            self._end_call()
            self._opener.failed()

    def _on_end(self, call: StreamCall, error: SpikeserveError) -> None:
        with self.changed:
            if call is not self._call:
                return
            self._drop_call()
            if self._opener.is_renewed:
                self._next_try = 0.0
            else:
                self._opener.failed()
                self._log_failure(error)
                self._pause_tries()
            self.changed.notify_all()

    # The state, with `changed` held.

    def _may_send(self, now: float) -> bool:
        return self._call is not None and self.session.is_open and now >= self._paused_until

    def _send_end(self, now: float) -> None:
        """Sends the end of the oldest episode and the beats before it, if they may be sent."""
        oldest = self.log.oldest
        has_ended = oldest.ending is not None and not self.log.is_ending
        if not has_ended or self._calls_end or not self._may_send(now):
            return
        fits = self._ends_on_stream and oldest.fits(self.log.most)
        has_room = len(self._under_way) < self._window
        if (fits and has_room) or not (self._under_way or (oldest.is_complete and not fits)):
            self._send(oldest, now, ends=fits)
            self.log.is_ending = fits

    def _send(self, episode: Episode, now: float, ends: bool = False) -> None:
        assert self._call is not None
        request = episode.request(self.session.session_id, self.log.most)
        if ends:
            request.end_episode.CopyFrom(episode.end_request(""))
        if request.HasField("observed_at"):
            request.valid_until = request.observed_at + int(self.options.oldest * 1e9)
        report = self.counters.report(now)
        if report is not None:
            request.report.CopyFrom(report)
        asks = len(request.observation) > 0
        self._under_way.append(_Request(episode, request.step, now, ends, asks))
        self._call.send(request)

    def _take_opening(self) -> None:
        self.log.history_limit = self.session.history_limit
        self.log.is_stored = self.session.is_stored

    def _end_call(self) -> None:
        if self._call is not None:
            self._call.cancel()
            self._drop_call()

    def _drop_call(self) -> None:
        self.counters.count(cancelled_calls=len(self._under_way))
        self._under_way.clear()
        self.log.is_ending = False
        self._call = None
        self._window = self.options.most_in_flight

    def _failed(self, error: SpikeserveError) -> None:
        with self.changed:
            expected = expected_decision(error)
            is_kept = expected is not None and self.log.rewind(expected, expected_episode(error))
            is_elsewhere = isinstance(error, NotFoundError) and self._may_be_elsewhere()
            if is_lost(error) and self.session.is_open and not (is_kept or is_elsewhere):
                self._lose(error.message, error)
            else:
                self._log_failure(error)
            self._pause_tries()

    def _may_be_elsewhere(self) -> bool:
        """Notes that a server does not know the session. Returns whether to ask on."""
        if not self.log.is_stored:
            return False
        now = time.monotonic()
        if self._denied_since is None:
            self._denied_since = now
        self._opener.denied()
        return now - self._denied_since < DENIED_SECONDS

    def _lose(self, reason: str, error: SpikeserveError | None = None) -> None:
        """Gives the session up: a new one continues with the beats that are kept.

        A beat that the server has refused as not valid would be refused again.
        """
        LOGGER.warning("the session is lost, and a new one is opened: %s", reason)
        self._end_call()
        self.session.lose()
        self.answer = None
        self._denied_since = None
        self._fail(self.log.begin_again(not isinstance(error, InvalidArgumentError)), reason)
        if self.session.local is not None:
            self.session.local.begin_again(self.log.running)

    @staticmethod
    def _fail(endings: list[Ending], reason: str) -> None:
        for ending in endings:
            ending.summary.set_exception(lost_episode(reason))

    def _log_failure(self, error: SpikeserveError) -> None:
        if self._pause == FIRST_PAUSE:  # the first of several
            LOGGER.warning("%s", error)

    def _pause_tries(self) -> None:
        self._next_try = time.monotonic() + self._pause
        self._pause = min(2 * self._pause, LONGEST_PAUSE)

    def _succeeded(self) -> None:
        self._denied_since = None
        self._opener.knows_session()
        self._pause = FIRST_PAUSE
        self._next_try = 0.0


def lost_episode(reason: str) -> SpikeserveError:
    """Returns the error of an episode whose end the server has not learned."""
    return make_error("EndEpisode", grpc.StatusCode.UNAVAILABLE, reason)
