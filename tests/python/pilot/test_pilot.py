"""A pilot gives every beat an action, and the server's session is what happened on the robot."""

import contextlib
import logging
import math
import tempfile
import time
from unittest import mock

import cbor2
import numpy as np
import pytest
import spikeserve
import spikeserve.piloting.link
from restartable_server import restartable_server
from security import until
from serving import SHIPPED_POLICIES, running_server
from spikeserve.piloting import robot_clock
from spikeserve.wire import METHODS

PERIOD = 0.01
MAX_AGE = 0.25  # seconds, what a pilot takes at this period
WAIT = 100  # seconds for what takes a moment
SIZES = {"cartpole": 4, "pendulum": 3}
LEARNING = spikeserve.SessionOptions(
    seed=5, sample=True, temperature=0.7, learning=spikeserve.Learning(learning_rate=0.5)
)
of_both_kinds = pytest.mark.parametrize(
    ("policy", "options"),
    [("pendulum", spikeserve.SessionOptions()), ("cartpole", LEARNING)],
    ids=["float", "learning"],
)


class Flight:
    """Flies a pilot with made-up observations, and remembers what was executed."""

    def __init__(self, client, policy="pendulum", period=PERIOD, **options):
        # On a busy machine answers are late. Only the test of stale answers is about that.
        options.setdefault("max_age", 30.0)
        self.policy, self.period = policy, period
        self.session = options.get("session", spikeserve.SessionOptions())
        self.pilot = self.make_pilot(client, policy, period=period, **options)
        self.episodes = [[]]  # lists of (observation, reward, action)
        self.endings = []
        self.summaries = []
        self.actions = []
        self.ages = []  # of the observations that the actions were chosen for, when their beats began; 0 or less: their own
        self.due = time.monotonic()
        self.asleep, self.clock = 0.0, None  # seconds of sleep, and what adds them

    make_pilot = spikeserve.Pilot

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.pilot.close()
        if self.clock:
            self.clock.stop()

    def suspend(self, seconds):
        """Does to the robot's clocks what its computer does when it sleeps for a while."""
        self.asleep += seconds
        if not self.clock:
            self.clock = mock.patch.object(robot_clock.time, "clock_gettime_ns", self.clock_gettime_ns)
            self.clock.start()

    def clock_gettime_ns(self, clock, read=time.clock_gettime_ns):
        return read(clock) + (int(self.asleep * 1e9) if clock == time.CLOCK_BOOTTIME else 0)

    def blind(self, beats, observation=None):
        """Plays beats without a valid observation. Returns their actions."""
        observation = [math.nan] * SIZES[self.policy] if observation is None else observation
        return [self.beat(observation) for _ in range(beats)]

    def beat(self, observation=None):
        """Plays one beat at its time."""
        t = len(self.actions)
        if observation is None:
            observation = [0.3 * math.sin(0.7 * t + k) for k in range(SIZES[self.policy])]
        reward = 0.1 * (t % 7)
        began = time.monotonic()
        action = self.pilot.beat(observation, reward)
        # At most: the pilot has computed the age before.
        self.ages.append(began - (time.monotonic() - action.age))
        assert action.source in ("fresh", "held", "local", "safe")
        assert action.beat == t and np.isfinite(action.action).all()
        self.episodes[-1].append((observation, reward, action.action))
        self.actions.append(action)
        self.due = max(self.due + self.period, time.monotonic() - self.period)
        time.sleep(max(0.0, self.due - time.monotonic()))
        return action

    def fly(self, beats):
        """Plays beats. Returns their sources."""
        return [self.beat().source for _ in range(beats)]

    def until(self, *sources):
        """Plays beats until one of them has one of the sources."""
        self.fly_until(lambda: self.actions[-1].source in sources)

    def fly_until(self, condition):
        """Plays at least one beat, until `condition()` is true."""
        end = time.monotonic() + WAIT
        self.beat()
        while not condition():
            assert time.monotonic() < end, self.pilot.stats()
            self.beat()

    def end(self, reward=1.0):
        self.endings.append(reward)
        self.episodes.append([])
        self.summaries.append(self.pilot.end_episode(reward, terminated=True))

    def local_value(self):
        """Returns the value of the session on the robot's engine."""
        return self.pilot._link.engine.value()

    def check_summaries(self):
        """Checks that the server has counted every reward of every episode once, as the robot has."""
        ended = zip(self.episodes, self.endings, self.summaries, strict=False)
        for beats, last, summary in ended:
            result = summary.result(WAIT)
            assert result.steps == len(beats), f"expected {len(beats)} steps, received {result}"
            rewards = sum(reward for _, reward, _ in beats[1:]) + last
            assert result.episode_return == pytest.approx(rewards), f"expected {rewards}, received {result}"
        assert self.pilot.stats().unequal_returns == 0

    def check_session(self, client):
        """Checks that the session at the server equals one that was never disturbed, bit for bit."""
        with undisturbed(has_store=bool(self.session.durability)) as other:
            self.check_equal(client, other)

    def check_equal(self, client, other):
        """As check_session. `other` is connected to a server that nothing disturbs."""
        self.check_summaries()
        opening = self.session.to_wire(self.policy)
        opening.session_id, opening.period_seconds = self.pilot.session_id, self.period
        other.call("OpenSession", opening)
        session = spikeserve.Session(other, self.pilot.session_id)
        returned = iter(self.actions)
        for beats, last in zip(self.episodes, self.endings, strict=False):
            before, answers = None, []
            for observation, reward, action in beats:
                answers.append(session.act(observation, reward, executed_action=before).action)
                before, one = action, next(returned)
                is_answer = any(np.array_equal(one.action, answer) for answer in reversed(answers))
                assert one.source != "fresh" or is_answer, f"beat {one.beat}: received {one.action}, which is no answer"
            session.end_episode(last, terminated=True, executed_action=before)
        values = [exported(each, session.session_id) for each in (client, other)]
        assert values[0] == values[1], f"session {session.session_id} differs from an undisturbed one"


@contextlib.contextmanager
def undisturbed(has_store=True):
    """Yields a client of a server, with a store or without: a session's value says how durable it is."""
    with tempfile.TemporaryDirectory() as folder:
        flags = [f"--session_store=file:{folder}"] if has_store else []
        with restartable_server(*flags) as server, spikeserve.Client(server.address) as client:
            yield client


def exported(client, session_id):
    """Returns the value of a session at the server."""
    request = METHODS["ExportSession"].request(session_id=session_id)
    return client.call("ExportSession", request).value


@pytest.fixture
def client(link):
    with spikeserve.Client(link.address) as client:
        yield client


@pytest.fixture
def fly():
    """Returns what makes a Flight. test_cpp_pilot.py plays these tests with the pilot of the C++ client."""
    return Flight


def test_a_quick_link_gives_fresh_actions(client, fly):
    with fly(client, local=False) as flight:
        flight.until("fresh")
        flight.fly(30)
        flight.end()
        flight.until("fresh")
        flight.end()
        flight.check_session(client)
        stats = flight.pilot.stats()
        assert stats.beats == len(flight.actions) == stats.fresh + stats.held + stats.safe
        assert stats.failures == stats.dropped == stats.lost_episodes == stats.invalid == 0
        assert 0 < stats.age_p50 <= stats.age_p99 <= stats.age_p999


def fly_through_cuts(flight, client, link, source):
    """Flies an episode in which the link is cut twice; actions then come from `source`. Nothing of it may be lost."""
    for _ in range(2):
        flight.until("fresh")
        flight.fly(5)
        link.cut()
        flight.until(source)
        flight.fly(40)
        link.heal()
        flight.until("fresh")
    flight.end()
    flight.check_session(client)
    assert flight.pilot.stats().failures == 0


def fly_through_five_seconds(flight, client, link):
    """Flies at 100 Hz while the link is cut for 5 s. Checks that every beat has an action and none is stale."""
    link.delay = 0.03  # so that old answers arrive some beats before new ones
    flight.until("fresh")
    flight.fly(5)
    link.cut()
    flight.fly(500)
    link.heal()
    flight.until("fresh")
    flight.end()
    flight.check_session(client)
    pilot_ages = zip(flight.actions, flight.ages, strict=True)
    assert max(age for action, age in pilot_ages if action.source == "fresh") <= MAX_AGE
    assert flight.pilot.stats().failures == 0


def test_five_seconds_without_a_cable_cost_no_action(client, link, fly):
    with fly(client, local=False, max_age=MAX_AGE) as flight:
        fly_through_five_seconds(flight, client, link)


@of_both_kinds
def test_a_cable_that_is_pulled_costs_nothing(client, link, policy, options, fly):
    with fly(client, policy, session=options, local=False) as flight:
        fly_through_cuts(flight, client, link, source="safe")


def test_a_connection_that_a_nat_has_forgotten_is_replaced(client, link, fly):
    with fly(client, local=False) as flight:
        flight.until("fresh")
        flight.fly(5)
        link.forget()
        flight.until("safe")
        flight.until("fresh")
        assert link.accepted == 2
        flight.end()
        flight.check_session(client)
        assert flight.pilot.stats().reconnects >= 1


def test_episodes_that_end_while_the_link_is_cut_are_not_lost(client, link, fly):
    with fly(client, local=False) as flight:
        flight.until("fresh")
        flight.fly(3)
        link.cut()
        for beats in (4, 1, 20, *[1] * 70):
            flight.fly(beats)
            flight.end()
        flight.fly(7)
        assert not any(summary.done() for summary in flight.summaries)
        link.heal()
        flight.until("fresh")
        flight.end()
        flight.check_session(client)


def begin_the_next_episode(flight, address):
    """Plays until the server has decided in the next episode, whose answers and that of the end are held."""
    with spikeserve.Client(address) as direct:
        before = len(flight.endings)
        flight.end()
        request = METHODS["GetSession"].request(session_id=flight.pilot.session_id)

        def has_decided():
            session = direct.call("GetSession", request)
            return session.episode > before and session.step >= 3

        flight.fly_until(has_decided)
    assert not flight.summaries[-1].done()


@pytest.mark.parametrize("is_forgotten", [False, True], ids=["late", "lost"])
@of_both_kinds
def test_the_next_episode_does_not_wait_for_the_answer_to_the_end(
    address, client, link, policy, options, is_forgotten, fly
):
    with fly(client, policy, session=options, local=False) as flight:
        for _ in range(2):
            flight.until("fresh")
            flight.fly(5)
            link.hold_answers()
            begin_the_next_episode(flight, address)
            if is_forgotten:
                link.forget()
            link.heal()
        flight.until("fresh")
        flight.end()
        flight.check_session(client)
        assert flight.pilot.stats().lost_episodes == flight.pilot.stats().reopened == 0


def test_an_end_that_never_arrived_is_sent_again(client, link, fly):
    with fly(client, local=False) as flight:
        flight.until("fresh")
        link.forget()
        flight.end()
        flight.until("fresh")
        flight.end()
        flight.check_session(client)


def test_an_earlier_server_ends_episodes_by_a_call(client, link, monkeypatch):
    send = spikeserve.piloting.link.StreamCall.send

    def send_without_end(self, request):
        request.ClearField("end_episode")  # what an earlier server does with it
        send(self, request)

    monkeypatch.setattr(spikeserve.piloting.link.StreamCall, "send", send_without_end)
    with Flight(client, local=False) as flight:
        for _ in range(3):
            flight.until("fresh")
            flight.fly(5)
            flight.end()
        flight.fly(2)
        flight.end()
        flight.check_session(client)
        assert flight.pilot.stats().lost_episodes == flight.pilot.stats().reopened == 0


def test_an_answer_that_is_stale_is_never_executed(client, link, fly):
    with fly(client, local=False, max_age=0.2) as flight:
        link.delay = 0.25
        flight.fly_until(lambda: flight.pilot.stats().stale >= 3)
        assert {action.source for action in flight.actions} == {"safe"}
        flight.end()
        link.delay = 0.0
        flight.check_session(client)


def test_the_newest_answer_that_could_arrive_is_executed(client, link, monkeypatch):
    """At 50 Hz, with a round trip of 50 ms, and 1 % of the segments lost."""
    arrived = [-1]  # steps of answers, in their order
    take = spikeserve.piloting.link.Link._on_reply

    def take_and_note(self, stream, reply):
        if reply.HasField("action"):
            reply.action.continuous.values[0] = reply.step / 1000  # shows which one is executed
        take(self, stream, reply)
        arrived.append(reply.step)

    monkeypatch.setattr(spikeserve.piloting.link.Link, "_on_reply", take_and_note)
    link.delay, link.loss = 0.025, 0.01
    with Flight(client, period=0.02, local=False) as flight:
        executed, newest = -1, []
        for _ in range(300):
            known = max(arrived)
            action = flight.beat()
            if action.source == "fresh":
                executed = round(1000 * float(action.action[0]))
            newest.append(executed >= known)
        assert sum(newest) >= 0.95 * len(newest)
        # With one request at a time, one beat of three would have an answer.
        assert len(arrived) >= 0.5 * len(newest)
        flight.end()
        flight.check_summaries()


def test_a_server_that_loses_its_sessions_gets_a_new_one(tmp_path, fly):
    with restartable_server() as server, spikeserve.Client(server.address) as client:
        with fly(client, local=False) as flight:
            flight.until("fresh")
            first = flight.pilot.session_id
            flight.end()
            flight.check_summaries()
            flight.fly(5)
            server.kill()
            flight.until("safe")
            flight.end()
            flight.fly(3)
            server.start()
            flight.until("fresh")
            assert flight.pilot.session_id != first
            with pytest.raises(spikeserve.UnavailableError):
                flight.summaries[1].result(WAIT)
            assert flight.pilot.stats().reopened == 1
            # The new session has the running episode from its first beat on.
            ended = flight.pilot.end_episode(1.0).result(WAIT)
            assert (ended.steps, ended.lost_steps) == (len(flight.episodes[-1]), 0)
            rewards = sum(reward for _, reward, _ in flight.episodes[-1][1:]) + 1.0
            assert ended.episode_return == pytest.approx(rewards)


def test_what_a_safety_layer_executes_is_what_the_server_remembers(client, fly):
    with fly(client, local=False) as flight:
        flight.until("fresh")
        torque = np.float32([0.125])
        observation, reward, _ = flight.episodes[-1].pop()
        flight.episodes[-1].append((observation, reward, torque))
        flight.actions.append(flight.pilot.beat([0.1, 0.2, 0.3], 0.5, executed_action=torque))
        flight.episodes[-1].append(([0.1, 0.2, 0.3], 0.5, flight.actions[-1].action))
        flight.end()
        flight.check_session(client)


def test_each_beat_says_who_chose_its_action(tmp_path, fly):
    sources = {"fresh": "policy", "held": "held", "local": "local", "safe": "safe"}
    with running_server(SHIPPED_POLICIES, flags=[f"--record_dir={tmp_path}"]) as addresses:
        with (
            spikeserve.Client(addresses.grpc) as client,
            fly(client, local=False, session=spikeserve.SessionOptions(record=True)) as flight,
        ):
            flight.until("fresh")
            flight.fly(3)
            torque = spikeserve.Executed(np.float32([0.125]), "operator", "anna")
            flight.actions.append(flight.pilot.beat([0.1, 0.2, 0.3], 0.5, executed_action=torque))
            flight.end()
            assert flight.summaries[0].result(WAIT).steps == len(flight.actions)
            expected = [sources[action.source] for action in flight.actions]
            expected[-2] = "operator:anna"
        until(lambda: list(tmp_path.rglob("*.cbor")))
    (path,) = tmp_path.rglob("*.cbor")
    assert cbor2.loads(path.read_bytes())["episodes"][0]["served"]["sources"] == expected


def test_nothing_that_a_robot_passes_makes_a_beat_fail(client, fly):
    with fly(client, local=False) as flight:
        flight.until("fresh")
        for observation, reward in [([1.0], 0.0), ([math.nan] * 3, 0.0), ("x", 0.0), ([0.0] * 3, math.inf)]:
            assert flight.pilot.beat(observation, reward).action.shape == (1,)
        assert flight.pilot.beat([0.0] * 3, None, executed_action=[9.0, 9.0]).action.shape == (1,)
        stats = flight.pilot.stats()
        assert (stats.invalid, stats.failures) == (6, 0)
        summary = flight.pilot.end_episode(1.0).result(WAIT)
        assert summary.steps == stats.beats


def test_a_target_that_is_no_number_is_that_of_the_session(client):
    with Flight(client, local=False) as flight:
        flight.until("fresh")
        assert flight.pilot.end_episode(1.0, target_return="far").result(WAIT).steps > 0
        assert flight.pilot.stats().invalid == 1


def test_a_pilot_that_closes_fails_what_the_server_does_not_have(client, link, fly):
    with fly(client, local=False, close_timeout=0.1) as flight:
        flight.until("fresh")
        link.cut()
        flight.fly(3)
        flight.end()
    with pytest.raises(spikeserve.UnavailableError, match="closed"):
        flight.summaries[0].result(WAIT)


def test_rungs_are_logged_once(client, link, caplog):
    with caplog.at_level(logging.INFO, "spikeserve.pilot"), Flight(client, local=False) as flight:
        flight.until("fresh")
        link.cut()
        flight.until("safe")
        flight.fly(50)
        entries = flight.pilot.stats().entries
        lines = [record.message for record in caplog.records if record.message.startswith("safe after")]
        assert len(lines) <= entries["safe"] < 10
        link.heal()


def test_the_server_must_be_there_when_a_pilot_is_made():
    options = spikeserve.ClientOptions(connect_timeout=0.1)
    with spikeserve.Client("127.0.0.1:1", options) as client:
        with pytest.raises(spikeserve.UnavailableError):
            spikeserve.Pilot(client, "pendulum", period=PERIOD)
