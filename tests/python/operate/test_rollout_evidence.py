"""One session, one tenant and mistakes of callers do not decide a roll-out."""

import shutil

import grpc
import pytest
from security import ADMIN, OBSERVATION, code_of, fails_with, service_with, until
from serving import SHIPPED_POLICIES, running_server

STABLE, NEW = 1, 2
GOOD, BAD = 400.0, 10.0


class Rollout:
    """A server that rolls version 2 of cartpole out, with agents of two tenants."""

    def __init__(self, admin):
        self.admin = admin

    # Without p99, which the other programs of a busy machine change.
    CONDITIONS = [{"measure": "MEASURE_RETURN"}, {"measure": "MEASURE_ERRORS", "margin": 0.01}]

    def start(self, **plan):
        self.admin.SetDefaultVersion(policy="cartpole", version=STABLE)
        self.admin.StartRollout(policy="cartpole", version=NEW, abort_if=self.CONDITIONS, **plan)

    def state(self):
        [rollout] = self.admin.ListRollouts().rollouts
        return rollout

    def name(self):
        return {1: "running", 2: "completed", 3: "aborted"}[self.state().state]


@pytest.fixture
def served(tmp_path, tokens):
    policies = tmp_path / "policies"
    for version in (STABLE, NEW):
        shutil.copytree(SHIPPED_POLICIES / "cartpole" / "1", policies / "cartpole" / str(version))
    settings = tmp_path / "settings"
    settings.mkdir()
    flags = [f"--tokens={tokens}", f"--policy_settings={settings}/settings.json"]
    with (
        running_server(policies, flags, log=tmp_path / "log") as addresses,
        service_with(addresses, "operator", ADMIN) as admin,
        service_with(addresses, "agent") as fleet,
        service_with(addresses, "rival") as rival,
    ):
        yield Rollout(admin), fleet, rival


def open_on(service, version):
    """Opens sessions until the roll-out assigns `version` to one. Returns it, or None if the roll-out has ended."""
    for _ in range(200):  # at a share of 50 %
        opened = service.OpenSession(policy="cartpole")
        if opened.version == version:
            return opened.session_id
        service.CloseSession(session_id=opened.session_id)
    return None


def episodes(service, session, returns):
    for reward in returns:
        service.Act(session_id=session, observation=OBSERVATION)
        service.EndEpisode(session_id=session, reward=reward, terminated=True)


def play(service, sessions, episode_return):
    """Plays sessions of one episode each, whose return is `episode_return(version)`."""
    for _ in range(sessions):
        opened = service.OpenSession(policy="cartpole")
        episodes(service, opened.session_id, [episode_return(opened.version)])
        service.CloseSession(session_id=opened.session_id)


def alike(_):
    return GOOD


def worse(version):
    return GOOD if version == STABLE else BAD


def test_one_session_does_not_abort_a_good_version(served):
    rollout, fleet, _ = served
    rollout.start(steps=[50, 100], hold_seconds=0.2, min_episodes=20)
    play(fleet, 40, alike)
    liar = open_on(fleet, NEW)
    episodes(fleet, liar, [-1e6] * 20 + [-2000.0] * 20)
    assert rollout.state().new_version_evidence.implausible_episodes == 20

    def ended():
        play(fleet, 10, alike)
        return rollout.name() != "running"

    until(ended)
    assert rollout.name() == "completed"


def test_one_session_a_round_does_not_complete_a_bad_version(served):
    rollout, fleet, _ = served
    # So many episodes that both versions have been compared before a step ends.
    rollout.start(steps=[50, 100], hold_seconds=0.1, min_episodes=60)

    def ended():
        play(fleet, 20, worse)
        liar = open_on(fleet, NEW)
        if liar is not None:
            episodes(fleet, liar, [1000.0] * 30)
        return rollout.name() != "running"

    until(ended)
    assert rollout.name() == "aborted"
    assert rollout.state().reason.startswith("return is worse")


def test_one_session_does_not_leave_a_step(served):
    rollout, fleet, _ = served
    rollout.start(steps=[50, 100], hold_seconds=0.05, min_episodes=20)
    episodes(fleet, open_on(fleet, NEW), [GOOD] * 100)
    assert rollout.state().percent == 50
    assert "16 more episodes of version 2, at most 4 of one session" in rollout.state().reason
    for _ in range(4):
        assert rollout.state().percent == 50
        episodes(fleet, open_on(fleet, NEW), [GOOD] * 4)
    # Nobody has played the stable version, with which this one is to be compared.
    assert rollout.state().percent == 50
    comparison = "waits for a comparison: 20 more sessions of version 2 and 20 of version 1"
    until(lambda: comparison in rollout.state().reason)  # the hold time is over
    for _ in range(20):
        episodes(fleet, open_on(fleet, STABLE), [GOOD])
    for _ in range(14):
        assert rollout.state().percent == 50
        episodes(fleet, open_on(fleet, NEW), [GOOD])
    episodes(fleet, open_on(fleet, NEW), [GOOD])
    until(lambda: rollout.state().percent == 100)


def test_the_mistakes_of_a_caller_do_not_count(served):
    rollout, fleet, _ = served
    rollout.start(steps=[50], hold_seconds=3600.0)
    play(fleet, 60, alike)
    for _ in range(60):
        session = open_on(fleet, NEW)
        wrong_size = {"session_id": session, "observation": [1.0]}
        assert code_of(fleet.Act, **wrong_size) == grpc.StatusCode.INVALID_ARGUMENT
        wrong_step = {"session_id": session, "observation": OBSERVATION, "step": 7}
        assert code_of(fleet.Act, **wrong_step) == grpc.StatusCode.FAILED_PRECONDITION
    play(fleet, 10, alike)
    assert rollout.name() == "running"
    assert rollout.state().new_version_evidence.failed_sessions == 0


def test_only_sessions_that_the_rollout_assigned_count(served):
    rollout, fleet, _ = served
    before = fleet.OpenSession(policy="cartpole", version=NEW).session_id
    rollout.start(steps=[50], hold_seconds=3600.0)
    rollout.admin.SetLabel(policy="cartpole", version=NEW, label="canary")
    for chosen in ({"version": NEW}, {"version_label": "canary"}, {"version": STABLE}):
        for _ in range(30):
            session = fleet.OpenSession(policy="cartpole", **chosen).session_id
            episodes(fleet, session, [-1000.0])
    episodes(fleet, before, [-1000.0])
    evidence = rollout.state()
    assert evidence.new_version_evidence.sessions == evidence.stable_version_evidence.sessions == 0
    play(fleet, 40, alike)
    evidence = rollout.state()
    assert evidence.new_version_evidence.sessions + evidence.stable_version_evidence.sessions == 40
    assert evidence.new_version_evidence.mean_return == GOOD


def test_one_tenant_neither_aborts_nor_completes(served):
    rollout, fleet, rival = served
    rollout.start(steps=[50, 100], hold_seconds=3600.0)
    play(fleet, 80, alike)
    play(rival, 80, worse)
    until(lambda: rollout.state().disputed)
    state = rollout.state()
    assert rollout.name() == "running"
    assert "but not without the sessions of one tenant" in state.reason
    assert "rival" not in state.reason
    # The other tenant sees it, too.
    play(fleet, 80, worse)

    def ended():
        play(fleet, 20, worse)
        play(rival, 20, worse)
        return rollout.name() != "running"

    until(ended)
    assert rollout.name() == "aborted"


def test_one_tenant_does_not_hide_that_a_version_is_worse(served):
    rollout, fleet, rival = served
    rollout.start(steps=[50, 100], hold_seconds=3600.0)

    def praise(version):
        return 1000.0 if version == NEW else 0.0

    play(rival, 300, praise)
    play(fleet, 100, worse)
    until(lambda: rollout.state().disputed)
    play(rival, 100, praise)
    state = rollout.state()
    assert (rollout.name(), state.percent, state.disputed) == ("running", 50, True)
    assert "without the sessions of one tenant, return is worse" in state.reason


def test_who_is_alone_for_long_decides(served, tmp_path):
    """Another tenant's single session neither contradicts nor blocks the others for ever."""
    rollout, fleet, rival = served
    rollout.start(steps=[50], hold_seconds=0.05, min_episodes=1000)  # less than between two verdicts
    play(rival, 1, alike)
    play(fleet, 80, worse)
    until(lambda: rollout.name() == "aborted")
    assert "roll-out disputed" in (tmp_path / "log").read_text()  # before it, so that others could contradict
    assert rollout.state().reason.endswith("no others have enough sessions to contradict it")


@pytest.mark.parametrize("min_episodes", [0, 1, 5])
def test_few_episodes_let_no_bad_version_serve_all(served, min_episodes):
    """The test needs 20 sessions of each version, whatever the plan says."""
    rollout, fleet, _ = served
    rollout.start(steps=[5, 50, 100], hold_seconds=0.05, min_episodes=min_episodes)

    def ended():
        play(fleet, 5, worse)
        state = rollout.state()
        assert state.percent < 100
        return rollout.name() != "running"

    until(ended)
    assert rollout.name() == "aborted"


def test_a_rollout_begins_with_a_part(served):
    rollout, _, _ = served
    with fails_with(grpc.StatusCode.INVALID_ARGUMENT, "steps: expected a first step below 100"):
        rollout.start(steps=[100])


@pytest.mark.parametrize("is_written_at_once", [True, False])
def test_while_it_is_disputed_the_stable_version_serves(served, tmp_path, is_written_at_once):
    """A version serves all sessions when one tenant's are found to be worse."""
    rollout, fleet, rival = served
    # So many episodes that each tenant has 20 sessions of either version, and contradicts the other, before all get it.
    rollout.start(steps=[50, 100], hold_seconds=0.05, min_episodes=1000)

    def served_by_all():
        for service in (fleet, rival):
            session = service.OpenSession(policy="cartpole").session_id
            episodes(service, session, [GOOD] * 10)
            service.CloseSession(session_id=session)
        return rollout.state().percent == 100

    until(served_by_all)

    def disputed():
        play(rival, 5, worse)
        return rollout.state().disputed

    if not is_written_at_once:
        settings = (tmp_path / "settings").rename(tmp_path / "away")
        until(lambda: disputed() or "roll-out not changed" in (tmp_path / "log").read_text())
        settings.rename(tmp_path / "settings")
    until(disputed)
    state = rollout.state()
    assert (rollout.name(), state.percent, state.step) == ("running", 50, 0)
    history = rollout.admin.ListHistory(policy="cartpole").entries
    assert "ReturnRollout" in [entry.action for entry in history]
