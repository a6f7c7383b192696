"""The engine of the Python package makes the decisions of a real server, bit for bit, and refuses what it refuses."""

import dataclasses
import threading

import grpc
import gymnasium
import numpy as np
import pytest
import spikeserve
import spikeserve.engine
import spikeserve_engine
from random_policy import export_random
from serving import SHIPPED_POLICIES, Service, running_server

EPISODES = 2
STEPS = 25  # more than a context of 20
CARTPOLE = SHIPPED_POLICIES / "cartpole/2/policy.safetensors"
SHIPPED = sorted(path.relative_to(SHIPPED_POLICIES).parent for path in SHIPPED_POLICIES.glob("*/*/*.safetensors"))
RANDOM = {
    "baseline": {"mode": "baseline"},
    "pos": {"mode": "pos"},
    "route": {"mode": "route"},
    "full": {"mode": "full"},
    "dense": {"mode": "dense"},
    "concat": {"mode": "full", "merge": "concat", "gate": "sigmoid"},
    "integer": {"mode": "full", "arithmetic": "integer"},
}
ENVIRONMENTS = {"discrete": "CartPole-v1", "box": "Pendulum-v1"}


@pytest.fixture(scope="module")
def random_policies(tmp_path_factory):
    """Writes a random policy of every kind for either action space. Returns their folder."""
    folder = tmp_path_factory.mktemp("policies")
    for name, config in RANDOM.items():
        for space, environment_id in ENVIRONMENTS.items():
            export_random(folder, f"{name}-{space}", gymnasium.make(environment_id), seed=1, **config)
    return folder


@pytest.fixture(scope="module")
def random_server(random_policies):
    with running_server(random_policies) as addresses:
        yield addresses.grpc


@pytest.fixture(scope="module")
def random_client(random_server):
    with spikeserve.Client(random_server) as opened:
        yield opened


def stats_of(stats):
    """Returns every field of the cost except the time and what the server's flags decide."""
    names = {field.name for field in dataclasses.fields(spikeserve.Stats)}
    names -= {"compute_seconds", "unusual_observations"}
    return {name: getattr(stats, name) for name in names if hasattr(stats, name)}


def play(session, observation_size, seed=3):
    """Plays episodes of random observations and rewards. Returns everything that the session answered."""
    random = np.random.default_rng(seed)
    answers = []
    for episode in range(EPISODES):
        for step in range(STEPS):
            observation = random.normal(0, 1, observation_size).astype(np.float32)
            decision = session.act(observation, float(random.integers(-2, 3)))
            assert decision.step == step
            probabilities = decision.action_probabilities
            answers.append(np.asarray(decision.action).tobytes())
            answers.append(None if probabilities is None else probabilities.tobytes())
            answers.append((decision.return_to_go, stats_of(decision.stats)))
        summary = session.end_episode(1.0, terminated=episode % 2 == 0, truncated=episode % 2 == 1)
        answers.append((summary.episode_return, summary.steps, summary.spikes, summary.energy_joules))
    state = session.state()
    answers.append((state.head_drift, state.trace_norm, state.spikes, state.energy_joules, state.decisions))
    return answers


# Settings of a session, and whether a Box allows them.
SETTINGS = {
    "greedy": ({"target_return": 50.0}, True),
    "sampled": ({"sample": True, "temperature": 0.7, "seed": 11}, True),
    "learning": ({"sample": True, "seed": 5, "learning": spikeserve.Learning(learning_rate=0.2)}, True),
    "hebbian": ({"learning": spikeserve.Learning(rule="hebbian", modulator="target")}, True),
    "greedy policy gradient": ({"learning": spikeserve.Learning(modulator="target")}, False),
}


def check_equal(client, path, policy, version, settings):
    engine = spikeserve_engine.Engine(path)
    with client.open_session(policy, spikeserve.SessionOptions(version=version, **settings)) as remote:
        expected = play(remote, engine.observation_size)
    assert play(engine.session(**settings), engine.observation_size) == expected


@pytest.mark.parametrize("settings", ["greedy", "sampled", "learning"])
@pytest.mark.parametrize("version", SHIPPED, ids=str)
def test_shipped_policies_play_as_on_the_server(client, version, settings):
    path = SHIPPED_POLICIES / version / "policy.safetensors"
    check_equal(client, path, version.parent.name, int(version.name), SETTINGS[settings][0])


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("space", ENVIRONMENTS)
@pytest.mark.parametrize("name", RANDOM)
def test_every_kind_of_policy_plays_as_on_the_server(random_client, random_policies, name, space, settings):
    given, allowed_for_box = SETTINGS[settings]
    if space == "box" and not allowed_for_box:
        pytest.skip("a greedy continuous action has no score to learn from")
    policy = f"{name}-{space}"
    check_equal(random_client, random_policies / policy / "1/policy.safetensors", policy, 1, given)


@pytest.mark.parametrize("settings", ["greedy", "sampled", "hebbian"])
def test_a_batch_decides_as_its_sessions_alone(settings):
    given, _ = SETTINGS[settings]
    engine = spikeserve_engine.Engine(CARTPOLE)
    alone = [engine.session(**given) for _ in range(5)]
    together = [engine.session(**given) for _ in range(5)]
    random = np.random.default_rng(0)
    rewards = None
    for step in range(STEPS):
        observations = random.normal(0, 0.1, (5, 4))  # float64, converted as Session.act converts it
        batch = engine.act_batch(together, observations, rewards)
        row_rewards = np.zeros(5) if rewards is None else rewards
        decisions = [s.act(o, r) for s, o, r in zip(alone, observations, row_rewards)]
        assert len(batch) == 5
        assert batch.actions.tolist() == [d.action for d in decisions]
        np.testing.assert_array_equal(batch.action_probabilities, [d.action_probabilities for d in decisions])
        assert batch.spikes.tolist() == [d.stats.spikes for d in decisions]
        assert batch.returns_to_go.tolist() == [d.return_to_go for d in decisions]
        assert batch[-1].action == decisions[-1].action
        rewards = random.normal(size=5)
    summaries = [s.end_episode(1.0, terminated=True).spikes for s in together]
    assert summaries == [s.end_episode(1.0, terminated=True).spikes for s in alone]


@pytest.mark.parametrize("name", ["cartpole", "pendulum"])
def test_the_rows_of_a_batch_are_decisions(name):
    """Of a Discrete and a Box space, for all fields of a decision."""
    engine = spikeserve_engine.Engine(SHIPPED_POLICIES / name / "1/policy.safetensors")
    observations = np.random.default_rng(0).normal(0, 0.1, (3, engine.observation_size))
    batch = engine.act_batch([engine.session() for _ in range(3)], observations)
    decisions = [engine.session().act(observation) for observation in observations]
    np.testing.assert_array_equal(batch.actions, [decision.action for decision in decisions])
    for index, alone in enumerate(decisions):
        row = batch[index]
        for field in ("action", "action_probabilities", "logits", "return_to_go", "step"):
            np.testing.assert_array_equal(getattr(row, field), getattr(alone, field), err_msg=field)
        assert row.stats.spikes_by_stage == alone.stats.spikes_by_stage
        assert row.stats.compute_seconds > 0


def test_a_batch_that_fails_changes_no_session():
    engine = spikeserve_engine.Engine(CARTPOLE)
    sessions = [engine.session(), engine.session()]
    observations = np.zeros((2, 4), np.float32)
    observations[1, 2] = np.nan
    with pytest.raises(ValueError, match=r"^row 1: observation\[2\]: expected a finite number, received nan$"):
        engine.act_batch(sessions, observations)
    with pytest.raises(ValueError, match="sessions: expected different sessions, received one session twice"):
        engine.act_batch([sessions[0], sessions[0]], np.zeros((2, 4)))
    for other in (3, None):
        with pytest.raises(TypeError, match=f"sessions: expected sessions, received .*{type(other).__name__}"):
            engine.act_batch([sessions[0], other], np.zeros((2, 4)))
    with pytest.raises(TypeError):
        engine.act_batch(sessions[0], np.zeros((1, 4)))
    with pytest.raises(ValueError, match="observations: expected 2 rows, received 3"):
        engine.act_batch(sessions, np.zeros((3, 4)))
    with pytest.raises(ValueError, match="received another engine's"):
        engine.act_batch([sessions[0], spikeserve_engine.Engine(CARTPOLE).session()], np.zeros((2, 4)))
    assert [session.step for session in sessions] == [0, 0]


def test_fleet_sessions_learn_one_head_as_on_the_server(random_client, random_policies):
    policy = "full-discrete"
    engine = spikeserve_engine.Engine(random_policies / policy / "1/policy.safetensors")
    learning = {"learning": spikeserve.Learning(scope="FLEET"), "sample": True}
    options = spikeserve.SessionOptions(**learning)
    with random_client.open_session(policy, options) as remote:
        expected = play(remote, engine.observation_size)
    assert play(engine.session(**learning), engine.observation_size) == expected
    other = engine.session(learning=spikeserve_engine.Learning(scope="FLEET"))
    assert other.state().head_drift == expected[-1][0] > 0


def test_a_head_is_handed_on():
    engine = spikeserve_engine.Engine(CARTPOLE)
    learned = engine.session(sample=True, learning=spikeserve_engine.Learning(max_drift=1.0))
    play(learned, 4)
    delta = learned.state().head_delta
    assert np.abs(delta).max() > 0
    continued = engine.session(head_delta=delta)
    assert continued.state().head_drift == pytest.approx(learned.state().head_drift)


@pytest.mark.parametrize("policy", ["full-discrete", "route-box", "integer-discrete", "dense-box"])
def test_explain_shows_what_the_server_shows(random_server, random_policies, policy):
    engine = spikeserve_engine.Engine(random_policies / policy / "1/policy.safetensors")
    local = engine.session()
    observations = np.random.default_rng(4).normal(size=(8, engine.observation_size)).astype(np.float32)
    with grpc.insecure_channel(random_server) as channel:
        service = Service(channel, "spikeserve.v1.PolicyService")
        session_id = service.OpenSession(policy=policy).session_id
        for step, observation in enumerate(observations):
            service.Act(session_id=session_id, step=step, observation=observation, reward=1.0)
            local.act(observation, 1.0)
        remote = service.Explain(session_id=session_id)
    ours = local.explain()
    assert (ours.mode, ours.layers, ours.heads, ours.ticks) == (remote.mode, remote.layers, remote.heads, remote.ticks)
    np.testing.assert_array_equal(ours.observation, np.asarray(remote.observation, np.float32))
    np.testing.assert_array_equal(ours.logits, np.asarray(remote.logits, np.float32))
    np.testing.assert_array_equal(ours.readout, np.asarray(remote.readout, np.float32))
    assert ours.decision.stats.spikes == remote.answer.stats.spikes
    assert len(ours.rasters) == len(remote.rasters)
    for mine, theirs in zip(ours.rasters, remote.rasters):
        layer = theirs.layer if theirs.HasField("layer") else None
        assert (mine.stage, mine.layer, mine.population) == (theirs.stage, layer, theirs.population)
        assert mine.token.timestep == theirs.token.timestep
        assert (mine.ticks.tolist(), mine.neurons.tolist()) == (list(theirs.ticks), list(theirs.neurons))
    for mine, theirs in zip(ours.attention, remote.attention, strict=True):
        assert mine.weights.shape == (theirs.ticks, remote.heads, len(theirs.keys))
        np.testing.assert_array_equal(mine.weights.ravel(), np.asarray(theirs.weights, np.float32))
        assert [key.timestep for key in mine.keys] == [key.timestep for key in theirs.keys]
    for mine, theirs in zip(ours.routing, remote.routing, strict=True):
        np.testing.assert_array_equal(mine.gates.ravel(), np.asarray(theirs.gates, np.float32))


# Settings and requests that the server refuses.
REFUSED_SETTINGS = [
    {"temperature": 0.5},
    {"sample": True, "temperature": -1.0},
    {"target_return": float("inf")},
    {"learning": spikeserve.Learning(rule="greed")},
    {"learning": spikeserve.Learning(learning_rate=-1.0)},
]
REFUSED_REQUESTS = [
    lambda session: session.act([0.0, 0.0, 0.0]),
    lambda session: session.act([0.0, float("nan"), 0.0, 0.0]),
    lambda session: (session.act(np.zeros(4)), session.act(np.zeros(4), float("inf"))),
    lambda session: (session.act(np.zeros(4)), session.act(np.zeros(4), 1e300)),
    lambda session: session.end_episode(0.0),
    lambda session: (session.act(np.zeros(4)), session.end_episode(0.0, target_return=float("nan"))),
]


@pytest.mark.parametrize("settings", REFUSED_SETTINGS, ids=str)
def test_settings_are_refused_in_the_servers_words(client, settings):
    with pytest.raises(spikeserve.SpikeserveError) as refused:
        client.open_session("cartpole", spikeserve.SessionOptions(**settings))
    with pytest.raises(ValueError) as ours:
        spikeserve_engine.Engine(CARTPOLE).session(**settings)
    assert str(ours.value) == refused.value.message


@pytest.mark.parametrize("request_", REFUSED_REQUESTS)
def test_requests_are_refused_in_the_servers_words(client, request_):
    with client.open_session("cartpole") as session, pytest.raises(spikeserve.SpikeserveError) as refused:
        request_(session)
    with pytest.raises((ValueError, RuntimeError)) as ours:
        request_(spikeserve_engine.Engine(CARTPOLE).session())
    assert str(ours.value) == refused.value.message
    expected = RuntimeError if isinstance(refused.value, spikeserve.FailedPreconditionError) else ValueError
    assert type(ours.value) is expected


def test_an_observation_has_one_dimension():
    session = spikeserve_engine.Engine(CARTPOLE).session()
    with pytest.raises(ValueError, match=r"observation: expected one dimension, received shape \(1, 4\)"):
        session.act(np.zeros((1, 4)))


def test_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        spikeserve_engine.Engine(tmp_path / "none.safetensors")
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(b"12345678")
    with pytest.raises(ValueError, match="broken.safetensors"):
        spikeserve_engine.Engine(broken)


def test_an_engine_describes_its_policy():
    engine = spikeserve_engine.Engine(str(CARTPOLE))
    assert (engine.observation_size, engine.action_space.n, engine.environment) == (4, 2, "CartPole-v1")
    assert (engine.mode, engine.arithmetic, engine.target_return) == ("full", "integer", 500.0)
    assert engine.training_return == 500.0
    pendulum = spikeserve_engine.Engine(SHIPPED_POLICIES / "pendulum/1/policy.safetensors")
    assert spikeserve.spaces.as_action_space(pendulum.action_space) == spikeserve.Box((-2.0,), (2.0,))


def test_threads_play_different_sessions_of_one_engine():
    engine = spikeserve_engine.Engine(CARTPOLE)
    expected = play(engine.session(seed=1, sample=True), 4)
    results = [None] * 4

    def run(i):
        results[i] = play(engine.session(seed=1, sample=True), 4)

    threads = [threading.Thread(target=run, args=(i,)) for i in range(len(results))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [expected] * len(results)


def test_the_lock_of_the_interpreter_is_free_during_an_explanation():
    """Another thread counts while one thread explains. With the lock held, it could not count at all."""
    session = spikeserve_engine.Engine(CARTPOLE).session()
    for _ in range(STEPS):
        session.act(np.full(4, 0.05))
    explained = threading.Event()
    counts = []

    def explain():
        session.explain()
        explained.set()

    thread = threading.Thread(target=explain)
    thread.start()
    while not explained.is_set():
        counts.append(len(counts))
    thread.join()
    assert len(counts) > 1000


def test_the_client_package_exports_the_engine():
    assert spikeserve.engine.Engine is spikeserve_engine.Engine
