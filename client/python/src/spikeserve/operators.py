"""`Operator`: holds robots, and acts in the place of their policies.

docs/guides/operators.md has examples, and says why a hold is no safety function.
"""

from __future__ import annotations

import concurrent.futures
import getpass
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import grpc

from spikeserve.admin import AdminClient
from spikeserve.calls import Call
from spikeserve.check import check
from spikeserve.connection import Connection
from spikeserve.errors import FailedPreconditionError, NotFoundError, SpikeserveError, is_retryable
from spikeserve.replicas import Replica, draw_id
from spikeserve.values import ActionLike, action_to_wire
from spikeserve.wire import ADMIN_METHODS, Message

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on

_TIMEOUT = 2.0  # of one call to one server, in seconds
_STORE_TIMEOUT = 30.0  # if it reads what the store has
_PAUSE = 0.02  # between two looks, in seconds
_PAGE = 10000  # sessions


@dataclass(frozen=True)
class HeldRobot:
    """A session that is held, as the server says that had it last."""

    session_id: str
    policy: str
    version: int
    tenant: str
    at_neutral: bool  # a later request showed it; False: not confirmed
    idle_seconds: float  # since the last contact
    silent: bool  # for longer than 50 of its periods and 2 s
    only_stored: bool  # no living server has it: the robot has asked none since its own ended
    server: str


@dataclass(frozen=True)
class HoldVerdict:
    """What became of a hold."""

    id: str
    robots: tuple[HeldRobot, ...]  # sorted by session_id
    # It outlives a restart of each server that has it; None: only `Operator.hold` learns it.
    kept: bool | None
    unreached: dict[str, str]  # the servers that did not answer or have no such hold, and why

    @property
    def not_confirmed(self) -> list[HeldRobot]:
        """Returns the robots that are not known to be at their neutral action."""
        return [robot for robot in self.robots if not robot.at_neutral]


class Control:
    """An operator's control of one session. Not thread-safe.

    Leaving the context returns it, unless the lease has ended or another operator has it.
    Nothing renews the lease by itself, so that no robot is left to an operator who has gone: only
    `act` and `renew` do. `agreement` is the share of the steps for which the policy had chosen the
    same action; None: there were none.
    """

    def __init__(self, operator: Operator, session_id: str, lease: Message) -> None:
        self._operator = operator
        self.session_id = session_id
        self.lease_id: str = lease.lease_id
        self.action_space: Message = lease.action_space
        self.relieved: str = lease.relieved_operator_id  # the operator before; "": none
        self.steps = 0  # that were answered with the operator's actions
        self.agreed_steps = 0
        self.hold_reason: str | None = None  # a hold is stronger than the operator; None: none

    def __enter__(self) -> Self:
        return self

    def __exit__(self, exception_type: type[BaseException] | None, *_: object) -> None:
        try:
            self.release()
        except FailedPreconditionError:
            pass  # there is nothing to return
        except SpikeserveError:
            if exception_type is None:  # otherwise the first exception matters more
                raise

    @property
    def agreement(self) -> float | None:
        """Returns the share of the steps in which operator and policy agreed."""
        return self.agreed_steps / self.steps if self.steps else None

    def act(self, action: ActionLike) -> None:
        """Renews the lease. The session answers with this action until the next one.

        FailedPreconditionError if the lease has ended, or another operator has taken it.
        """
        self._steer(action_to_wire(action))

    def renew(self) -> None:
        """Renews the lease with the same action. Errors as `act`."""
        self._steer(None)

    def _steer(self, action: Message | None) -> None:
        answer = self._operator._of_session(
            "SteerSession", session_id=self.session_id, lease_id=self.lease_id, action=action
        )
        self.steps, self.agreed_steps = answer.steps, answer.agreed_steps
        self.hold_reason = answer.hold.reason if answer.HasField("hold") else None

    def release(self) -> None:
        """Ends the lease: the policy acts again with the next decision. Errors as `act`."""
        answer = self._operator._of_session(
            "ReturnControl", session_id=self.session_id, lease_id=self.lease_id
        )
        self.steps, self.agreed_steps = answer.steps, answer.agreed_steps


class Operator:
    """The calls of one operator, at all servers of `client`. Thread-safe.

    `operator_id` is the name in answers and recordings; None: that of the user of this computer.
    `client` stays open, and its token needs the role operator. Closed as a context manager.
    """

    def __init__(self, client: Connection, operator_id: str | None = None) -> None:
        self._admin = AdminClient(client.server, client.options, client.credentials)
        self._id = getpass.getuser() if operator_id is None else operator_id
        self._owner: dict[str, Replica] = {}  # of sessions, where they were last
        self._tenant = ""  # that servers give to holds without one; "": none, or not known

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._admin.close()

    def take(
        self,
        session_id: str,
        lease: float = 1.0,
        *,
        take_over: bool = False,
        action: ActionLike | None = None,
    ) -> Control:
        """Takes control of a session for `lease` seconds, in [0.1, 60], from each action on.

        The first action is `action`; None: the neutral one, or that of the operator who is
        relieved. FailedPreconditionError if another operator has control, unless `take_over`.
        NotFoundError if no server has the session: its robot asks none.
        """
        answer = self._of_session(
            "TakeControl",
            session_id=session_id,
            lease_seconds=lease,
            lease_id=draw_id(),
            operator_id=self._id,
            take_over=take_over,
            action=action_to_wire(action),
        )
        return Control(self, session_id, answer)

    def hold(
        self,
        *,
        policy: str = "",
        version: int = 0,
        tenant: str = "",
        label: str = "",
        session_ids: Sequence[str] = (),
        all_sessions: bool = False,
        reason: str = "",
        hold_id: str = "",
        wait: float = 2.0,
    ) -> HoldVerdict:
        """Holds the sessions that meet every condition, also later ones, until `resume`.

        `label` is KEY=VALUE. Returns when all robots are known to be at their neutral action, or
        after `wait` seconds. Raises the error of the first server if none holds.
        """
        hold_id = hold_id or draw_id()
        selection = _selection(policy, version, tenant, label, session_ids, all_sessions)
        answers = self._everywhere("HoldSessions", id=hold_id, reason=reason, selection=selection)
        held = [answer for _, answer in answers if not isinstance(answer, SpikeserveError)]
        if not held:
            raise next(error for _, error in answers)
        refused = {at.address: str(e) for at, e in answers if isinstance(e, SpikeserveError)}
        kept = all(answer.kept for answer in held)
        if not tenant:
            self._tenant = held[0].hold.selection.tenant
        ends = time.monotonic() + wait
        while True:
            verdict = self._verdict(hold_id, kept, False, refused)
            settled = not verdict.not_confirmed and not verdict.unreached
            if settled or time.monotonic() >= ends:
                return self._verdict(hold_id, kept, True, refused)
            time.sleep(_PAUSE)

    def verdict(self, hold_id: str, *, stored: bool = True) -> HoldVerdict:
        """Returns where the robots of a hold are now.

        `stored`: also of the sessions that only the store has, all of which the servers then read.
        """
        return self._verdict(hold_id, None, stored, {})

    def resume(
        self,
        hold_id: str = "",
        *,
        policy: str = "",
        version: int = 0,
        tenant: str = "",
        label: str = "",
        session_ids: Sequence[str] = (),
        all_sessions: bool = False,
    ) -> None:
        """Ends a hold by its id, or the holds that were made with exactly this selection.

        Holds of an operator who sees one tenant are of that tenant: an `Operator` that has held
        nothing itself needs `tenant` to end them by their selection. NotFoundError if no server has
        such a hold that this operator may end. Raises the error of a server that may have it still.
        """
        if hold_id:
            self._end(hold_id)
            return
        wanted = _selection(policy, version, tenant, label, session_ids, all_sessions)
        expected = "a hold_id, a condition, or all_sessions for the hold of every session"
        check(any(wanted.values()), "selection", expected, "none of them")
        wanted["tenant"] = tenant or self._tenant
        lists = [answer for _, answer in self._everywhere("ListHolds")]
        holds = [hold for answer in lists for hold in getattr(answer, "holds", ())]
        ended = False
        failure: SpikeserveError | None = None
        for one in {hold.hold.id for hold in holds if _is_same(hold.selection, wanted)}:
            try:
                self._end(one)
                ended = True
            except NotFoundError:
                pass  # another operator has ended it, or only one who sees all tenants may
            except SpikeserveError as error:
                failure = error
        if not ended and failure is None:
            failures = (answer for answer in lists if isinstance(answer, SpikeserveError))
            # A server that was not reached may have the hold.
            failure = next(failures, _no_such_hold(holds, wanted))
        if failure is not None:
            raise failure

    def _end(self, hold_id: str) -> None:
        answers = [answer for _, answer in self._everywhere("ResumeSessions", id=hold_id)]
        errors = [answer for answer in answers if isinstance(answer, SpikeserveError)]
        # A server that was not reached may have the hold, unless it shares one that has ended.
        failures = [error for error in errors if not isinstance(error, NotFoundError)]
        if len(errors) == len(answers):
            raise (failures or errors)[0]
        if failures and not any(getattr(answer, "shared", False) for answer in answers):
            raise failures[0]

    def _verdict(
        self, hold_id: str, kept: bool | None, stored: bool, refused: Mapping[str, str]
    ) -> HoldVerdict:
        """`refused` says why servers have refused the hold."""
        newest: dict[tuple[str, str], tuple[int, HeldRobot]] = {}
        unreached: dict[str, str] = {}
        token = dict.fromkeys(self._admin.replicas, "")
        while token:
            pages = self._everywhere(
                "ListHolds", list(token), tokens=token, id=hold_id, page_size=_PAGE, stored=stored
            )
            for replica, page in pages:
                is_error = isinstance(page, SpikeserveError)
                if is_error or not page.holds:
                    why = refused.get(replica.address, "the server has no such hold")
                    unreached[replica.address] = str(page) if is_error else why
                    token.pop(replica)
                    continue
                for session in page.sessions:
                    fields = HeldRobot.__dataclass_fields__.keys() - {"server"}
                    values = {name: getattr(session, name) for name in fields}
                    key = (session.tenant, session.session_id)
                    epoch = -1 if session.only_stored else session.epoch
                    if key not in newest or newest[key][0] < epoch:
                        newest[key] = epoch, HeldRobot(**values, server=replica.address)
                if page.next_page_token <= token[replica]:  # the last page
                    token.pop(replica)
                else:
                    token[replica] = page.next_page_token
        robots = sorted((robot for _, robot in newest.values()), key=lambda r: r.session_id)
        return HoldVerdict(hold_id, tuple(robots), kept, unreached)

    def _everywhere(
        self,
        rpc: str,
        replicas: Sequence[Replica] | None = None,
        tokens: dict[Replica, str] | None = None,
        **fields: Any,
    ) -> list[tuple[Replica, Any]]:
        """Makes a call at every server, or at `replicas`, at once: a response or error of each."""
        asked = list(self._admin.replicas) if replicas is None else list(replicas)

        def ask(replica: Replica) -> Any:
            page = {} if tokens is None else {"page_token": tokens[replica]}
            try:
                return self._ask(replica, rpc, {**fields, **page})
            except SpikeserveError as error:
                return error

        with concurrent.futures.ThreadPoolExecutor(len(asked)) as pool:
            return list(zip(asked, pool.map(ask, asked), strict=True))

    def _of_session(self, rpc: str, **fields: Any) -> Message:
        """Makes a call at the server that has the session, which may move meanwhile."""
        session_id = fields["session_id"]
        first = self._owner.get(session_id)
        order = sorted(self._admin.replicas, key=lambda replica: replica is not first)
        failure: SpikeserveError | None = None
        for replica in order:
            try:
                answer = self._ask(replica, rpc, fields)
            except SpikeserveError as error:
                if not (isinstance(error, NotFoundError) or is_retryable(error)):
                    raise
                # A server that cannot be reached may have the session.
                if failure is None or isinstance(failure, NotFoundError):
                    failure = error
            else:
                self._owner[session_id] = replica
                return answer
        assert failure is not None
        raise failure

    def _ask(self, replica: Replica, rpc: str, fields: dict[str, Any]) -> Message:
        request = ADMIN_METHODS[rpc].request(**fields)
        timeout = _STORE_TIMEOUT if fields.get("stored") else _TIMEOUT
        return self._admin.run_once(Call(rpc, request, lambda answer: answer), replica, timeout)


def _selection(
    policy: str,
    version: int,
    tenant: str,
    label: str,
    session_ids: Sequence[str],
    all_sessions: bool,
) -> dict[str, Any]:
    key, is_pair, value = label.partition("=")
    check(bool(is_pair) or not label, "label", "KEY=VALUE", repr(label))
    return {
        "policy": policy,
        "version": version,
        "tenant": tenant,
        "labels": {key: value} if label else {},
        "session_ids": list(session_ids),
        "all": all_sessions,
    }


def _is_same(selection: Message, wanted: dict[str, Any]) -> bool:
    return bool(
        selection.policy == wanted["policy"]
        and selection.version == wanted["version"]
        and selection.tenant == wanted["tenant"]
        and dict(selection.labels) == wanted["labels"]
        and list(selection.session_ids) == wanted["session_ids"]
    )


def _no_such_hold(holds: Sequence[Message], wanted: dict[str, Any]) -> NotFoundError:
    selections = [hold.selection for hold in holds if hold.selection.tenant]
    near = [s.tenant for s in selections if _is_same(s, wanted | {"tenant": s.tenant})]
    hint = f", such as the one with tenant {min(near)!r}" if near else ""
    given = ", ".join(f"{name} {value!r}" for name, value in wanted.items() if value)
    message = f"selection: expected that of a hold{hint}, received {given}"
    return NotFoundError("ResumeSessions", grpc.StatusCode.NOT_FOUND, message)
