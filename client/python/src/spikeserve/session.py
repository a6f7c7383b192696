"""`Session`: the session of one agent, blocking."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

from spikeserve.connection import Connection
from spikeserve.errors import SessionLostError, SpikeserveError
from spikeserve.explanation import Explanation
from spikeserve.session_handle import SessionHandle
from spikeserve.values import Decision, EpisodeSummary, ExecutedLike, SessionState

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on


class Session(SessionHandle[Connection]):
    """The session of one agent. Not thread-safe. Many sessions may share one client.

    A session is a session id and a step. A restarted agent attaches to its old session with
    Session(client, session_id, step). A request for the last answered step returns the stored
    answer of that step. `opening` is None for an attached session.

    A session that is stored (`opening.durability` is not NONE) outlives its server. The client
    keeps the requests that the store may not have yet, and sends them again to the server that goes
    on with the session. DivergedError if one of them gets another answer than before.
    """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, exception_type: type[BaseException] | None, *_: object) -> None:
        try:
            self.close()
        except SpikeserveError:
            if exception_type is None:  # otherwise the first exception matters more
                raise

    def act(
        self,
        observation: ArrayLike,
        reward: float | None = None,
        timeout: float | None = None,
        *,
        executed_action: ExecutedLike | None = None,
    ) -> Decision:
        """Returns the decision at this step and moves to the next step.

        `observation` is in environment units. `reward` is for the previous action: step 0 ignores
        it, and every later step needs it (ValueError). `executed_action` is the action that was
        executed at the previous step, if it differs from the answered one, for example because a
        safety layer clipped it: the model remembers it, recordings hold it, and learning takes its
        score. ValueError, or InvalidArgumentError from the server, if it does not belong to the
        action space.

        `timeout` bounds the whole call with its retries, in seconds. After an error the session
        stays at its step, and the same call may be made again.

        SessionLostError if the server does not know the session any more. A session that was opened
        with `reopen=True` then continues with a new one, and `observation` is step 0 of its first
        episode: what the lost session remembered and learned is gone.
        """
        try:
            return self._client.run(self.cursor.act(observation, reward, timeout, executed_action))
        except SessionLostError:
            if not self.reopens:
                raise
        self.open_again()
        return self._client.run(self.cursor.act(observation, 0.0, timeout))

    def end_episode(
        self,
        reward: float,
        terminated: bool = False,
        truncated: bool = False,
        target_return: float | None = None,
        observation: ArrayLike | None = None,
        *,
        executed_action: ExecutedLike | None = None,
    ) -> EpisodeSummary:
        """Sends the last reward, ends the episode and moves to step 0 of the next episode.

        `target_return` is for the next episode; None: the target return of the session.
        `observation` is the final observation, which only recordings use. `executed_action` is the
        executed last action, as for `act`. A repeated call is safe: the server counts the end once
        and returns the same summary. SessionLostError if the session was lost with the totals of
        its episode; with `reopen=True` the next `act` plays in a new session.
        """
        ending = self.cursor.end_episode(
            reward, terminated, truncated, target_return, observation, executed_action
        )
        try:
            return self._client.run(ending)
        except SessionLostError:
            if self.reopens:
                self.open_again()
            raise

    def state(self, *, include_head_delta: bool = False) -> SessionState:
        """Returns the state of the session on the server, on request with its learned head."""
        return self._client.run(self.cursor.state(include_head_delta))

    def explain(self) -> Explanation:
        """Returns the spikes, attention, gates and logits of the last decision.

        Takes about a thousand times as long as a decision. FailedPreconditionError before the first
        decision of an episode.
        """
        return self._client.run(self.cursor.explain())

    def open_again(self) -> None:
        """Opens a new session in the place of a lost one, with the options of the first.

        ValueError if the session was not opened with `reopen=True`.
        """
        self._move_to(self._client.run(self._reopening()))

    def close(self) -> None:
        """Ends the session on the server. Does nothing if it was closed before, or lost."""
        if not self._closed:
            with contextlib.suppress(SessionLostError):
                self._client.run(self.cursor.close())
            self._closed = True
