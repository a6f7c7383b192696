"""Every client has every option of the wire contract.

Each test compares an interface with the fields of a message by its descriptor. A field that is added to the contract
fails a test until the clients have it, or until this file says why they do not need it.
"""

import asyncio
import dataclasses
import inspect
import os
import re

import numpy as np
import pytest
import spikeserve
from serving import run, running_server
from spikeserve.admin import method_name
from spikeserve.wire import ADMIN_METHODS, METHODS, message_class

# Fields that a library sets by itself, so that its user does not have to.
BY_THE_LIBRARY = {
    "OpenSessionRequest": {
        # The id makes a repeated OpenSession find the session that a lost answer has opened.
        "session_id",
        # Of robots on real links, for which a plain session is not made. A label does the same.
        "period_seconds",
        "names_in_any_order",
        "datagrams",
    },
    # The session counts its steps and decisions. A plain session asks for every step, so it has no history.
    "ActRequest": {
        *("session_id", "step", "decision"),
        *("history", "skipped_rewards", "observed_at", "valid_until", "report", "end_episode"),
        "traceparent",  # of the active span
        "executed_source",  # of an Executed
    },
    "EndEpisodeRequest": {"session_id", "episode", "steps", "executed_source"},
    "AmendEpisodeRequest": {"session_id"},  # `session`, which may be a recording
    "GetSessionRequest": {"session_id"},
    "PolicyInfo": {"neutral_action"},  # of robots on real links, as below
    "OpenSessionResponse": {"session_id", "history_limit", "neutral_action", "datagrams"},
    "ActResponse": {
        *("session_id", "error", "datagrams"),  # the session, an exception, and the pilots
        # Set for requests with history or an end only.
        *("observed_at", "next_step", "appended", "dropped", "expired", "queue_seconds", "append_seconds", "ended"),
    },
    "ExplainResponse": set(),
}
# Names that differ from those of the contract.
RENAMED = {"action_selection": "sample", "observation_names": "observation", "action_names": "action"}
# The tasks of `spikectl run` have the order of the policies.
OF_ROBOTS = {"observation", "action", "observation_units", "action_units", "rate_hz", "wiring"}


def fields_of(message):
    """Returns the names of the fields that a user sees, as the clients call them."""
    names = {field.name for field in message_class(message).DESCRIPTOR.fields}
    return {RENAMED.get(name, name) for name in names - BY_THE_LIBRARY.get(message, set())}


def parameters_of(function):
    return set(inspect.signature(function).parameters) - {"self"}


def attributes_of(value_class):
    return {field.name for field in dataclasses.fields(value_class)}


@pytest.mark.parametrize(
    "message, value_class, more",
    [
        ("LearningConfig", spikeserve.Learning, set()),
        ("LearningSummary", spikeserve.LearningSummary, set()),
        ("PolicyInfo", spikeserve.Policy, set()),
        ("OpenSessionResponse", spikeserve.Opening, set()),
        ("ActResponse", spikeserve.Decision, set()),
        ("DecisionStats", spikeserve.Stats, set()),
        ("EndEpisodeResponse", spikeserve.EpisodeSummary, set()),
        ("AmendEpisodeResponse", spikeserve.AmendedEpisode, set()),
        ("GetSessionResponse", spikeserve.SessionState, set()),
        ("ExplainResponse", spikeserve.Explanation, set()),
        ("SpikeRaster", spikeserve.SpikeRaster, set()),
        ("Token", spikeserve.Token, set()),
        ("RoutingGates", spikeserve.RoutingGates, set()),
        # The shape of the weights has the number of ticks.
        ("Attention", spikeserve.Attention, {"ticks"}),
    ],
)
def test_values_have_every_field(message, value_class, more):
    # The source of an action is a kind and, of an operator, a name.
    assert attributes_of(value_class) - {"operator_id"} | more == fields_of(message)


def test_sessions_have_every_option():
    # The policy is the first argument of open_session.
    assert attributes_of(spikeserve.SessionOptions) | {"policy"} == fields_of("OpenSessionRequest")


@pytest.mark.parametrize("session", [spikeserve.Session, spikeserve.AsyncSession])
def test_the_calls_of_a_session_have_every_argument(session):
    assert parameters_of(session.act) - {"timeout"} == fields_of("ActRequest")
    assert parameters_of(session.end_episode) == fields_of("EndEpisodeRequest")
    assert parameters_of(session.state) == fields_of("GetSessionRequest")
    for client in (spikeserve.Client, spikeserve.AsyncClient):
        assert parameters_of(client.amend_episode) == fields_of("AmendEpisodeRequest") | {"session"}
    streams = {spikeserve.Session: spikeserve.ActStream, spikeserve.AsyncSession: spikeserve.AsyncActStream}
    assert parameters_of(streams[session].send) - {"session"} == fields_of("ActRequest")


def plural(name):
    return f"{name}s"


def test_batches_have_every_argument():
    expected = {plural(name) for name in fields_of("ActRequest")}
    for client in (spikeserve.Client, spikeserve.AsyncClient):
        assert parameters_of(client.act_batch) - {"sessions", "timeout"} == expected
    ends = {"terminations", "truncations", "infos", "timeout"}
    for vector in (spikeserve.VectorSession, spikeserve.AsyncVectorSession):
        assert parameters_of(vector.act) - ends == expected


def test_every_method_of_the_service_can_be_called():
    homes = {
        "ListPolicies": "list_policies",
        "OpenSession": "open_session",
        "ActBatch": "act_batch",
        "ActStream": "act_stream",
        "Act": "act",
        "EndEpisode": "end_episode",
        "AmendEpisode": "amend_episode",
        "GetSession": "state",
        "Explain": "explain",
        "CloseSession": "close",
    }
    assert homes.keys() | {"ExportSession"} == METHODS.keys()  # the value is of use on a robot only
    for client, session in (
        (spikeserve.Client, spikeserve.Session),
        (spikeserve.AsyncClient, spikeserve.AsyncSession),
    ):
        for name in homes.values():
            assert hasattr(client, name) or hasattr(session, name)


@pytest.mark.parametrize("client", [spikeserve.AdminClient, spikeserve.AsyncAdminClient])
def test_operators_have_every_call(client):
    for rpc, method in ADMIN_METHODS.items():
        call = getattr(client, method_name(rpc))
        expected = {field.name for field in method.request.DESCRIPTOR.fields}
        assert parameters_of(call) == expected | {"timeout"}
        assert call.__doc__  # the comment of the contract


def flags_of(program, *command):
    # Completion scripts have every flag, also those that --help leaves to the manual.
    text = run(os.environ[program], *command, "--generate=bash").stdout
    return set(re.findall(r"--(\w+)", text))


def test_spikectl_run_has_every_option():
    flags = flags_of("SPIKECTL_PROGRAM", "run")
    # The switch --learn selects the scope. --scope is that of adapt.
    options = fields_of("OpenSessionRequest") - {"learning"} - OF_ROBOTS | {"learn"}
    learning = fields_of("LearningConfig") - {"scope"}
    assert options | learning <= flags
    assert learning | {"scope"} <= flags_of("SPIKECTL_PROGRAM", "adapt")


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    recordings = tmp_path_factory.mktemp("recordings")
    with running_server(flags=[f"--record_dir={recordings}"]) as addresses:
        yield addresses.grpc


def test_options_reach_the_server(server):
    with spikeserve.AdminClient(server) as admin, spikeserve.Client(server) as client:
        admin.set_label(policy="cartpole", label="old", version=1)
        options = spikeserve.SessionOptions(
            version_label="old",
            routing_key="robot-7",
            target_return=123.0,
            labels={"robot": "a"},
            sample=True,
            record=True,
            learning=spikeserve.Learning(
                discount=0.9, max_drift=0.5, guard_margin=0.1, trace_decay=0.5, learning_rate=0.2
            ),
        )
        with client.open_session("cartpole", options) as session:
            assert (session.opening.version, session.opening.target_return) == (1, 123.0)
            for _ in range(5):
                session.act(np.zeros(4), 1.0)
            summary = session.end_episode(1.0, terminated=True)
            assert summary.learning.updates == 1 and summary.learning.head_drift > 0
            state = session.state(include_head_delta=True)
            assert state.head_delta.any() and state.modulator_std > 0
            assert session.state().head_delta is None
            assert state.labels == {"robot": "a"}
        learned = spikeserve.SessionOptions(version=1, head_delta=state.head_delta)
        with client.open_session("cartpole", learned) as session:
            assert session.state().head_drift == pytest.approx(state.head_drift)
        (policy,) = [p for p in client.list_policies() if p.version_labels == ("old",)]
        assert (policy.name, policy.version, policy.is_shadow) == ("cartpole", 1, False)
        for field, value in (("max_drift", -1.0), ("discount", 2.0), ("guard_margin", -1.0)):
            refused = spikeserve.SessionOptions(learning=spikeserve.Learning(**{field: value}))
            with pytest.raises(spikeserve.InvalidArgumentError, match=f"learning.{field}"):
                client.open_session("cartpole", refused)


def check_explanation(explanation):
    counted = {stage: 0 for stage in explanation.answer.stats.spikes_by_stage}
    for raster in explanation.rasters:
        counted[raster.stage] += len(raster.ticks)
        assert raster.ticks.max(initial=0) < explanation.ticks
    assert counted == explanation.answer.stats.spikes_by_stage
    assert len(explanation.attention) == explanation.layers
    for attention in explanation.attention:
        assert attention.weights.shape == (explanation.ticks, explanation.heads, len(attention.keys))
        np.testing.assert_allclose(attention.weights.sum(axis=-1), 1, rtol=1e-5)
        assert attention.keys[-1] == spikeserve.Token("STATE", 1)
    for gates in explanation.routing:
        assert gates.gates.shape == (len(gates.tokens), explanation.ticks, explanation.heads)


def test_decisions_are_explained(server):
    with spikeserve.Client(server) as client, client.open_session("cartpole") as session:
        with pytest.raises(spikeserve.FailedPreconditionError):
            session.explain()
        session.act(np.zeros(4))
        decision = session.act(np.full(4, 0.01), 1.0)
        explanation = session.explain()
        check_explanation(explanation)
        assert explanation.answer.stats == decision.stats
        assert explanation.answer.action == np.argmax(explanation.logits)

    async def explain():
        async with spikeserve.AsyncClient(server) as client:
            assert "cartpole" in [policy.name for policy in await client.list_policies()]
            async with await client.open_session("cartpole") as session:
                await session.act(np.zeros(4))
                await session.act(np.zeros(4), 0.0)
                return await session.explain()

    check_explanation(asyncio.run(explain()))


def test_operators_calls_work(server):
    with spikeserve.AdminClient(server) as admin:
        assert admin.get_head(policy="cartpole").version == 2
        with pytest.raises(spikeserve.NotFoundError, match="nobody"):
            admin.set_label(policy="nobody", label="x", version=1)
        with pytest.raises(ValueError, match="no .*field"):
            admin.get_head(polizy="cartpole")

    async def drain():
        async with spikeserve.AsyncAdminClient(server) as admin:
            drained = await admin.drain()
            await admin.drain(cancel=True)
            return drained

    assert asyncio.run(drain()).open_sessions >= 0
    assert "Refuses new sessions" in spikeserve.AdminClient.drain.__doc__


def test_spikectls_options_reach_the_server(server, tmp_path):
    def played(*flags, status=0):
        return run("spikectl", "run", f"--server={server}", "--episodes=2", *flags, status=status)

    with spikeserve.AdminClient(server) as admin:
        admin.set_label(policy="cartpole", label="old", version=1)
        size = len(admin.get_head(policy="cartpole", include_weights=True).base)
    assert "with policy cartpole/1 " in played("--version_label=old", "--labels=robot=7,site=a").stdout
    played("--learn=session", "--sample", "--rule=hebbian", "--max_drift=0.5", "--clip=0.1")
    head = tmp_path / "head.json"
    head.write_text(str([0.0] * size))
    played(f"--head_delta={head}")
    for flags, message in (
        (["--rule=hebbian"], "--learn: expected session or fleet with flags of the learning"),
        (["--learn=session", "--rule=habit"], '--rule: expected policy_gradient, hebbian, hebbian_action or corrections, received "habit"'),
        (["--temperature=2"], "--temperature: expected --sample with it, received 2"),
        (["--labels=robot"], '--labels: expected KEY=VALUE, received "robot"'),
        (["--head_delta=/nowhere"], "--head_delta: cannot read /nowhere"),
        (["--version_label=nobody"], "nobody"),
        (["--learn=session", "--max_drift=-1"], "max_drift"),
    ):
        assert message in played(*flags, status=1).stderr
