"""The status page and the JSON documents that it reads, while agents play."""

import json

import pytest
from google.protobuf import json_format
from security import until
from serving import SHIPPED_POLICIES, add_version, http_call, page_of, running_server

OBSERVATIONS = {"robot": [0.01, -0.02, 0.03, 0.1], "pendulum": [0.1, 0.2, 0.3]}
COLUMNS = (
    *("session_id", "policy", "episode", "step", "episode_return", "decisions"),
    *("mean_return", "last_return", "spikes_per_decision", "energy_joules", "energy_joules_per_decision", "head_drift", "idle_seconds"),
)


@pytest.fixture
def server(tmp_path):
    """Starts a server with two versions of `robot`, and pendulum, which nobody has played yet."""
    for version in (1, 2):
        add_version(tmp_path, "robot", version, SHIPPED_POLICIES / "cartpole-small/1")
    add_version(tmp_path, "pendulum", 1, SHIPPED_POLICIES / "pendulum/1")
    with running_server(tmp_path) as started:
        yield started


def play(server, policy, steps, **opening):
    """Opens a session and makes decisions. Returns its id."""
    session = server.agent.OpenSession(policy=policy, **opening).session_id
    for step in range(steps):
        server.agent.Act(session_id=session, step=step, observation=OBSERVATIONS[policy])
    return session


def document(server, path, code=200):
    """Returns the JSON document at `path`, or the error, if its code is that."""
    answered, headers, body = http_call(server.http, "GET", path)
    assert answered == code, (path, body)
    assert headers["Content-Type"].startswith("application/json")
    return json.loads(body)


def sessions(server, query):
    return [session["session_id"] for session in document(server, f"/sessions.json?{query}")["sessions"]]


def test_the_page_and_its_files_come_from_the_program_alone(server):
    code, headers, body = http_call(server.http, "GET", "/")
    assert code == 200
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert headers["Content-Security-Policy"].startswith("default-src 'none'")
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert b"<title>spikeserve</title>" in body
    assert b"http://" not in body and b"https://" not in body
    for path, kind in (("/main.js", "text/javascript"), ("/style.css", "text/css")):
        assert http_call(server.http, "GET", path)[1]["Content-Type"].startswith(kind)
    assert "The MIT License" in page_of(server, "/vendor/uplot/LICENSE")
    for path in ("/nothing", "/../CMakeLists.txt"):
        assert http_call(server.http, "GET", path)[0] == 404


def test_status_holds_policies_and_the_figures_of_metrics(server):
    play(server, "robot", 7)
    status = document(server, "/status.json")
    assert status["serving"] is True
    assert status["time"] > 0
    assert [(each["name"], each["version"], each["is_default"]) for each in status["policies"]] == [
        ("pendulum", "1", True),
        ("robot", "1", False),
        ("robot", "2", True),
    ]
    [decisions] = status["metrics"]["spikeserve_decisions_total"]
    played = {"policy": "robot", "version": "2"}
    assert (decisions["labels"], decisions["value"]) == (played, 7)
    for series in status["metrics"]["spikeserve_decision_duration_seconds"]:
        assert series["count"] == (7 if series["labels"] == played else 0)
        assert series["buckets"][-1] == [None, series["count"]]  # None: infinity
    metrics = page_of(server, "/metrics")
    for name in status["metrics"]:
        assert f"# TYPE {name}" in metrics


def test_sessions_are_filtered_sorted_and_paged(server):
    busy = play(server, "robot", 9, labels={"robot": "Marvin", "Site": "Ulm"})
    idle = play(server, "pendulum", 1, labels={"robot": "C-3PO"})
    middling = play(server, "robot", 4)
    for query, expected in (
        ("sort=decisions&order=descending", [busy, middling, idle]),
        ("sort=decisions", [idle, middling, busy]),
        ("filter=robot%2F2&sort=step", [middling, busy]),
        ("filter=robot=marvin", [busy]),
        ("filter=site%3DULM", [busy]),
        (f"filter={idle}", [idle]),
        # A match lies within one label.
        *((f"filter={both}", []) for both in ("ulmrobot", "ulm%FFrobot", "%FF")),
    ):
        assert sessions(server, query) == expected, query
    for column in COLUMNS:
        assert len(sessions(server, f"sort={column}")) == 3, column
    page = document(server, "/sessions.json?filter=pendulum&page_size=5")
    assert (page["open"], page["matching"], page["next_page_token"]) == (3, 1, "")
    [session] = page["sessions"]
    assert (session["policy"], session["version"], session["step"]) == ("pendulum", "1", "1")
    assert session["labels"] == {"robot": "C-3PO"}
    assert session["energy_joules"] > 0
    assert list(session["energy_joules_per_decision"]) == ["int_sram_45nm", "int_45nm", "horowitz_45nm", "spike_5pj"]


def test_a_row_has_every_field_of_its_session(server):
    """Also of one that learns, has labels that need escapes, and whose robot reports its beats."""
    labels = {"robot": 'R2 "D2"', "Straße": "7\\"}
    session = play(server, "robot", 1, labels=labels, learning={"scope": "SESSION"}, period_seconds=0.02)
    for step in range(1, 5):
        server.agent.Act(
            session_id=session, step=step, observation=OBSERVATIONS["robot"], reward=0.1, report={"held": 7 * step}
        )
    [row] = document(server, "/sessions.json?sort=energy_joules&filter=stra%C3%9Fe=7")["sessions"]
    [info] = server.admin.ListSessions().sessions
    expected = json_format.MessageToDict(
        info, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )
    assert row["labels"] == document(server, f"/session.json?session={session}")["labels"] == labels | {"period_seconds": "0.02"}
    assert (row["decisions"], row["mean_return"]) == ("5", None)
    for field in info.DESCRIPTOR.fields:
        if field.name != "idle_seconds":  # passes between both calls
            assert row[field.name] == expected.get(field.name), field.name
    assert row["idle_seconds"] > 0


def test_pages_of_sessions_continue_behind_the_last_one(server):
    """They add up to the whole list although a session that was listed already continues."""
    for i in range(7):
        play(server, "robot", 1 + i % 3)
    query = "sort=decisions&order=descending"
    expected = sessions(server, query)
    listed, token = [], ""
    while not listed or token:
        page = document(server, f"/sessions.json?{query}&page_size=3&page_token={token}")
        assert len(page["sessions"]) <= 3
        listed += [session["session_id"] for session in page["sessions"]]
        if not token:
            server.agent.Act(session_id=listed[0], step=3, observation=OBSERVATIONS["robot"])
        token = page["next_page_token"]
    assert listed == expected


def test_sessions_without_an_ended_episode_have_no_return(server):
    good, bad, fresh = (play(server, "robot", 2) for _ in range(3))
    server.agent.EndEpisode(session_id=good, reward=5.0)
    server.agent.EndEpisode(session_id=bad, reward=-5.0)
    assert sessions(server, "sort=mean_return") == [bad, good, fresh]
    assert sessions(server, "sort=mean_return&order=descending") == [good, bad, fresh]
    assert document(server, f"/sessions.json?filter={fresh}")["sessions"][0]["mean_return"] is None


def test_a_session_has_the_history_of_its_life(server):
    session = play(server, "robot", 70)
    server.agent.EndEpisode(session_id=session, reward=5.0)
    shown = document(server, f"/session.json?session={session}")
    assert (shown["session_id"], shown["decisions"]) == (session, "70")
    parts, spikes = 0, 0.0
    for part in shown["history"]["decisions"]:
        assert part["first"] == parts
        parts += part["count"]
        spikes += part["spikes_per_decision"] * part["count"]
    assert parts == 70
    assert spikes == pytest.approx(float(shown["spikes"]), abs=1)
    [episode] = shown["history"]["episodes"]
    assert episode["mean_return"] == shown["last_return"]


def test_figures_and_their_history_count_what_agents_do(server):
    play(server, "robot", 7)
    # The history is collected every two seconds.
    until(lambda: document(server, "/status.json?window=600&metrics=false")["figures"]["decisions"] == 7)
    status = document(server, "/status.json?window=600&metrics=false")
    assert status["metrics"] == {}
    decisions = {(each["policy"], each["version"]): each["decisions"] for each in status["versions"]}
    assert decisions == {("pendulum", "1"): 0, ("robot", "1"): 0, ("robot", "2"): 7}
    assert status["figures"]["spikes_per_decision"] > 0
    assert status["alerts"]
    history = document(server, "/history.json?seconds=600")
    [version] = history["versions"]
    assert version["policy"] == "robot"
    assert len(version["decisions_per_second"]) == len(history["seconds_ago"])


def test_the_last_decision_is_explained(server):
    session = play(server, "robot", 6)
    explained = document(server, f"/explain.json?session={session}")
    assert (explained["session_id"], explained["answer"]["step"]) == (session, "5")
    spikes = sum(len(raster["ticks"]) for raster in explained["rasters"])
    assert explained["answer"]["stats"]["spikes"] == str(spikes)


def test_mistakes_are_named(server):
    fresh = server.agent.OpenSession(policy="robot").session_id
    play(server, "robot", 1)
    token = document(server, "/sessions.json?page_size=1")["next_page_token"]
    assert token
    deep = "gYGB" * 3000  # CBOR: arrays in arrays
    two_to_61 = ("myAAAAAAAAAA", "uyAAAAAAAAAA")  # an array and a map that claim as many elements
    for path, http, code, message in (
        ("/explain.json?session=nobody", 404, "NOT_FOUND", "nobody"),
        ("/explain.json", 404, "NOT_FOUND", "session_id: expected"),
        (f"/explain.json?session={fresh}", 409, "FAILED_PRECONDITION", "step 0"),
        ("/session.json?session=nobody", 404, "NOT_FOUND", "nobody"),
        *(
            (f"/{name}", 400, "INVALID_ARGUMENT", message)
            for name, message in (
                *(
                    (f"sessions.json?page_size={size}", f'page_size: expected a whole number from 1 to 1000, received "{size}')
                    for size in ("0", "1001", "1e2", "", "9" * 20)
                ),
                *(
                    (f"sessions.json?page_token={each}", "page_token: ")
                    for each in ("x", "AAAA", "%FF", "hPWA", deep, *two_to_61)
                ),
                (f"sessions.json?sort=step&page_token={token}", "the same sort and order"),
                ("status.json?window=0", "window: expected"),
                ("status.json?metrics=no", "metrics: expected"),
                ("history.json?seconds=1801", "seconds: expected"),
                ("sessions.json?sort=mood", "sort: expected one of"),
                ("sessions.json?order=up", "order: expected"),
                ("sessions.json?colour=red", '"colour"'),
                ("sessions.json?filter=a&filter=b", "filter: expected once"),
                ("sessions.json?sort=%FF%FE", "sort: expected one of"),
            )
        ),
    ):
        error = document(server, path, http)
        assert error["code"] == code, path
        assert message in error["message"], path
