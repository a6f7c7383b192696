"""Each energy model shows what it counts, and has figures only for the policies to which it applies."""

import gymnasium
import pytest
from documentation import page_of
from random_policy import SMALL, export_random
from serving import running_server, status_of

STEPS = 7
MULTIPLY_ACCUMULATE = 4.6e-12  # joules, of horowitz_45nm
# The optional figures of an answer and the models that they belong to.
FIGURES = {
    "spike_energy_joules": "spike_5pj",
    "int_energy_joules": "int_45nm",
    "int_sram_energy_joules": "int_sram_45nm",
}
APPLYING = {
    "integers": {"horowitz_45nm", "int_45nm", "int_sram_45nm", "spike_5pj"},
    "floats": {"horowitz_45nm", "spike_5pj"},
    "dense": {"horowitz_45nm"},
}


@pytest.fixture(scope="module")
def addresses(tmp_path_factory):
    policies = tmp_path_factory.mktemp("policies")
    environment = gymnasium.make("CartPole-v1")
    export_random(policies, "integers", environment, arithmetic="integer")
    export_random(policies, "floats", environment)
    export_random(policies, "dense", environment, mode="dense")
    with running_server(policies) as started:
        yield started


@pytest.fixture(scope="module")
def stats(addresses):
    """Plays an episode with every policy. Returns the stats of its decisions, by policy."""
    played = {}
    for policy in APPLYING:
        session = addresses.agent.OpenSession(policy=policy).session_id
        observations = [[0.1 * step, 0.2, -0.1 * step, 0.3] for step in range(STEPS)]
        played[policy] = [
            addresses.agent.Act(session_id=session, step=step, observation=observation).stats
            for step, observation in enumerate(observations)
        ]
    yield played


@pytest.mark.parametrize("policy", APPLYING)
def test_an_answer_has_a_figure_for_each_model_that_applies(stats, policy):
    for answer in stats[policy]:
        assert answer.energy_joules > 0
        figures = {model for field, model in FIGURES.items() if answer.HasField(field)}
        assert figures == APPLYING[policy] - {"horowitz_45nm"}


@pytest.mark.parametrize("policy", APPLYING)
def test_the_metrics_have_the_same_figures_and_no_others(addresses, stats, policy):
    series = {
        entry["labels"]["energy_model"]: entry["value"]
        for entry in status_of(addresses)["metrics"]["spikeserve_energy_joules_total"]
        if entry["labels"]["policy"] == policy
    }
    assert set(series) == APPLYING[policy]
    assert series["horowitz_45nm"] == pytest.approx(sum(s.energy_joules for s in stats[policy]))
    for field, model in FIGURES.items():
        if model in series:
            assert series[model] == pytest.approx(sum(getattr(s, field) for s in stats[policy]))


def test_a_policy_has_the_energy_of_its_dense_baseline_beside_it(addresses, stats):
    """A dense policy with the same sizes is played, in float32, until its window is full."""
    assert set(stats) >= {"integers", "floats"}, "policies that were played"
    session = addresses.agent.OpenSession(policy="dense").session_id
    for step in range(SMALL["context"] + 1):
        observation = [0.1 * step, 0.2, -0.1 * step, 0.3]
        answer = addresses.agent.Act(session_id=session, step=step, observation=observation, reward=1.0)
    found = {}
    for entry in status_of(addresses)["metrics"]["spikeserve_dense_energy_joules"]:
        found.setdefault(entry["labels"]["policy"], {})[entry["labels"]["energy_model"]] = entry["value"]
    assert set(found) == {"integers", "floats"}
    assert set(found["integers"]) == {"horowitz_45nm", "int_45nm", "int_sram_45nm"}
    assert set(found["floats"]) == {"horowitz_45nm"}
    assert found["floats"]["horowitz_45nm"] == found["integers"]["horowitz_45nm"]
    # Of an action that is one of two, one input is 0 and multiplies nothing.
    skipped = SMALL["hidden_size"] * MULTIPLY_ACCUMULATE
    assert found["floats"]["horowitz_45nm"] == pytest.approx(answer.stats.energy_joules + skipped)


def test_membranes_of_float32_depend_on_the_sizes_only(stats):
    first, *others = [answer.membrane_updates for answer in stats["floats"]]
    assert others == [others[0]] * (STEPS - 1)
    assert first < others[0], "the first decision has no action token"
    # Integers update them by events.
    assert all(0 < answer.membrane_updates < others[0] for answer in stats["integers"])
    assert {answer.membrane_updates for answer in stats["dense"]} == {0}


def test_the_page_of_the_documentation_is_that_of_the_program(addresses):
    models = status_of(addresses)["energy_models"]
    assert [model["name"] for model in models if model["default"]] == ["horowitz_45nm"]
    assert [model["name"] for model in models][:2] == ["int_sram_45nm", "int_45nm"], "memory first"
    table = page_of("energy.md").read_text().split("<!-- energy models -->\n")[1].split("<!--")[0]
    _, _, *rows = table.splitlines()
    assert rows == [
        f"| `{model['name']}` | " + " | ".join(model[key] for key in ("counts", "leaves_out", "applies_to", "source")) + " |"
        for model in models
    ]
