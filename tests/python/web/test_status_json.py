"""Checks every JSON document of the HTTP port against the schema that the server publishes."""

import json
import shutil

import grpc
import jsonschema
import pytest

from security import until
from serving import DEPLOY, SHIPPED_POLICIES, http_call, page_of, running_server, status_of

SCHEMA_FILE = DEPLOY.parent / "server" / "web" / "static" / "schema.json"
OBSERVATION = [0.01, -0.02, 0.03, 0.1]


def play(agent):
    """Plays an episode and a half. Leaves the session open, and returns its id."""
    session = agent.OpenSession(policy="robot", labels={"robot": "a"}).session_id
    for step in range(5):
        agent.Act(session_id=session, step=step, observation=OBSERVATION, reward=1.0)
    agent.EndEpisode(session_id=session, reward=1.0, terminated=True)
    agent.Act(session_id=session, step=0, observation=OBSERVATION)
    with pytest.raises(grpc.RpcError):
        agent.Act(session_id=session, step=7, observation=OBSERVATION)
    return session


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """Starts a server with a roll-out, a label, a shadow and a session. Yields it and the session."""
    policies = tmp_path_factory.mktemp("policies")
    for version in ("1", "2"):
        shutil.copytree(SHIPPED_POLICIES / "cartpole" / "1", policies / "robot" / version)
    with running_server(policies) as addresses:
        addresses.admin.SetDefaultVersion(policy="robot", version=1)
        addresses.admin.SetLabel(policy="robot", version=1, label="stable")
        addresses.admin.SetShadow(policy="robot", shadow_version=2)
        addresses.admin.StartRollout(policy="robot", version=2, steps=[50, 100])
        session = play(addresses.agent)
        until(lambda: status_of(addresses)["figures"]["decisions"] == 6)
        yield addresses, session


def validate(definition, document):
    schema = json.loads(SCHEMA_FILE.read_text())
    jsonschema.Draft202012Validator({**schema, "anyOf": [{"$ref": f"#/$defs/{definition}"}]}).validate(document)


def test_the_schema_is_valid_and_published(server):
    published = page_of(server[0], "/schema.json")
    assert published == SCHEMA_FILE.read_text()
    jsonschema.Draft202012Validator.check_schema(json.loads(published))


@pytest.mark.parametrize(
    ("definition", "path"),
    [
        ("status", "/status.json"),
        ("status", "/status.json?window=600&metrics=false"),
        ("history", "/history.json"),
        ("history", "/history.json?seconds=1800"),
        ("sessions", "/sessions.json"),
        ("sessions", "/sessions.json?filter=nothing"),
        ("session", "/session.json?session={session}"),
        ("usage", "/usage.json?by=day,tenant,policy,label"),
        ("explain", "/explain.json?session={session}"),
    ],
)
def test_documents_follow_the_schema(server, definition, path):
    addresses, session = server
    document = json.loads(page_of(addresses, path.format(session=session)))
    validate(definition, document)
    # The definitions are closed, so a field that the schema does not know is found.
    with pytest.raises(jsonschema.ValidationError):
        validate("error", document)


def test_errors_follow_the_schema(server):
    code, _, error = http_call(server[0].http, "GET", "/session.json?session=nobody")
    assert code == 404
    validate("error", json.loads(error))


def test_the_documents_hold_what_the_page_shows(server):
    addresses, session = server
    status = status_of(addresses, "?window=600")
    [first, second] = status["versions"]
    assert [first["version"], second["version"]] == ["1", "2"]
    assert first["decisions"] + second["decisions"] == 6
    assert status["figures"]["episodes"] == 1
    assert status["figures"]["return_mean"] == 5.0
    assert 0 < status["figures"]["refused_ratio"] < 1
    assert sum(status["figures"]["spikes_by_stage"].values()) == pytest.approx(
        status["figures"]["spikes_per_decision"]
    )
    [rollout] = status["rollouts"]
    assert rollout["state"] == "STATE_RUNNING"
    listed = json.loads(page_of(addresses, "/sessions.json?sort=mean_return"))
    assert [row["session_id"] for row in listed["sessions"]] == [session]
    assert listed["sessions"][0]["last_return"] == 5.0
