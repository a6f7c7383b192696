"""The ledger counts what was used, once, and budgets end where it says so."""

import contextlib
import csv
import io
import itertools
import json
import os
import re
import time

import grpc
import gymnasium
import pytest
from machine import Clock
from random_policy import export_random
from redis_servers import WITHOUT_REDIS, Redis, stopping
from security import ADMIN, OBSERVATION, TOKENS, code_of, entry, fails_with, service_with, until
from serving import DEPLOY, http_call, page_of, refusal_at_start, running_server, series
from stored_sessions import replicas_on

OFTEN = "--usage_interval=50ms"
NEVER = "--usage_interval=1h"
EXHAUSTED = grpc.StatusCode.RESOURCE_EXHAUSTED


def play(service, steps, close=False, **options):
    """Plays a session. Returns the spikes of its answers."""
    session = service.OpenSession(**({"policy": "cartpole"} | options)).session_id
    answers = [service.Act(session_id=session, step=t, observation=OBSERVATION) for t in range(steps)]
    if close:
        service.CloseSession(session_id=session)
    return sum(answer.stats.spikes for answer in answers)


def usage_of(admin, **fields):
    return list(admin.GetUsage(**fields).rows)


def total(admin):
    rows = usage_of(admin)
    return rows[0].usage if rows else None


def test_a_killed_server_had_booked_nothing_and_loses_nothing(tmp_path):
    """What the journals of a file store have is booked at the next start, and once."""
    store = f"--session_store=file:{tmp_path}/store"
    with running_server(flags=[store, NEVER]) as server:
        spikes = play(server.agent, 20, durability="SYNC") + play(server.agent, 3, durability="SYNC")
        spikes += play(server.agent, 5, close=True, durability="SYNC")
        assert total(server.admin).decisions == 5  # the end of a session is booked before its journal is gone
        server.kill()
    for _ in range(2):
        with running_server(flags=[store, OFTEN]) as server:
            until(lambda: total(server.admin).decisions >= 28)
            usage = total(server.admin)
            assert (usage.decisions, usage.spikes) == (28, spikes)
    assert usage.sessions == 1  # what the journals do not have ended with the process


def test_the_days_that_a_server_was_off_count_nothing_again(tmp_path):
    clock = Clock(tmp_path / "clock")
    start = {"flags": [f"--session_store=file:{tmp_path}/store", OFTEN], "prefix": clock.prefix}
    step = {"observation": OBSERVATION, "reward": 1.0}
    with running_server(**start) as server:
        session = server.agent.OpenSession(policy="cartpole", durability="SYNC").session_id
        for t in range(20):
            server.agent.Act(session_id=session, step=t, **step)
    clock.jump(3 * 86400)
    with running_server(**start) as server:
        for others in (1, 2):  # when the second is counted, the ledger has forgotten what it forgets
            play(server.agent, 1)
            until(lambda: total(server.admin).decisions >= 20 + others)
        server.agent.Act(session_id=session, step=20, **step)
        play(server.agent, 1)
        until(lambda: total(server.admin).decisions >= 24)
        assert total(server.admin).decisions == 24


@WITHOUT_REDIS
def test_answers_count_that_a_take_over_overtakes():
    """Of ASYNC, a former owner answers what the store then refuses, and what the new owner never sees."""
    with stopping([Redis(password="")]) as [redis], replicas_on(redis, flags=[OFTEN]) as (first, second):
        session = first.OpenSession(policy="cartpole", durability="ASYNC").session_id
        steps = [{"step": t, "observation": OBSERVATION, "reward": 1.0} for t in range(3)]
        until(lambda: code_of(second.Act, session_id=session, decision=0, **steps[0]) == grpc.StatusCode.OK)
        beats = [step | {"executed": {"discrete": 0}} for step in steps[:2]]
        first.Act(session_id=session, decision=2, history=beats, **steps[2])
        second.CloseSession(session_id=session)
        until(lambda: total(second.admin) is not None and total(second.admin).decisions == 3)


@WITHOUT_REDIS
def test_the_ledger_leaves_a_primary_that_became_a_replica():
    """It keeps its connections, and refuses writes."""
    with stopping([Redis(password="")]) as servers:
        old = servers[0]
        new = Redis("--replicaof", "127.0.0.1", str(old.port), password="")
        servers.append(new)
        store = f"--session_store=redis://127.0.0.1:{old.port},127.0.0.1:{new.port}"
        with running_server(flags=[store, OFTEN]) as server:

            def booked():
                with contextlib.suppress(grpc.RpcError):
                    return usage.decisions if (usage := total(server.admin)) else 0

            play(server.agent, 3, durability="NONE")
            until(lambda: booked() == 3)
            until(lambda: new.command("HGETALL us:{u}:p") == old.command("HGETALL us:{u}:p"))
            assert new.command("REPLICAOF NO ONE") == b"OK"
            assert old.command(f"REPLICAOF 127.0.0.1 {new.port}") == b"OK"
            play(server.agent, 4, durability="NONE")
            until(lambda: booked() == 7)


@pytest.mark.parametrize("folder", [True, False])
def test_sessions_that_are_not_stored(folder, tmp_path):
    flags = [f"--usage_dir={tmp_path}/usage"] if folder else []
    with running_server(flags=[*flags, NEVER]) as server:
        spikes = play(server.agent, 4)
        assert usage_of(server.admin) == []  # within the interval
    with running_server(flags=[*flags, OFTEN]) as server:
        usage = total(server.admin)
        assert (usage.decisions, usage.spikes) == (4, spikes) if folder else usage is None


def test_rows_are_told_apart_and_have_a_figure_of_each_model(tmp_path):
    environment = gymnasium.make("CartPole-v1")
    export_random(tmp_path, "integers", environment, arithmetic="integer")
    export_random(tmp_path, "floats", environment)
    with running_server(tmp_path, [OFTEN, "--usage_label=robot"]) as server:
        report = {"fresh": 5, "held": 2, "local": 1, "safe": 1}
        for policy, robot in (("integers", "ann"), ("integers", "bob, the \"second\""), ("floats", "ann")):
            options = {"policy": policy, "labels": {"robot": robot, "site": "x"}, "period_seconds": 0.02}
            session = server.agent.OpenSession(**options).session_id
            server.agent.Act(session_id=session, observation=OBSERVATION, report=report, step=0, decision=0)
        until(lambda: total(server.admin) and total(server.admin).decisions == 3)
        rows = usage_of(server.admin, by=["policy", "label", "hour"])
        named = [(row.policy, row.label) for row in rows if row.policy]
        assert named == [("floats", "ann"), ("integers", "ann"), ("integers", 'bob, the "second"')]
        models = [set(row.usage.joules) for row in rows if row.policy]
        assert models == [{"horowitz_45nm"}, *[{"horowitz_45nm", "int_45nm", "int_sram_45nm"}] * 2]
        usage = total(server.admin)
        assert (usage.fresh, usage.held, usage.local, usage.safe, usage.sessions) == (15, 6, 3, 3, 3)
        assert usage.bytes > 0 and abs(time.time() - rows[0].start) < 7200

        printed = server.spikectl("usage", "--by=policy,label", "--csv").stdout
        lines = list(csv.DictReader(io.StringIO(printed)))
        assert [(line["policy"], line["label"]) for line in lines if line["policy"]] == named
        assert sum(int(line["decisions"]) for line in lines) == 3
        month = time.strftime("%Y-%m", time.gmtime())
        first, head, row = server.spikectl("usage", f"--month={month}", "--by=tenant").stdout.splitlines()[:3]
        assert month in first and head.split()[3:5] == ["INT_SRAM_J", "HOROWITZ_J"]
        sums = [sum(float(line[f"joules_{model}"]) for line in lines) for model in ("int_sram_45nm", "horowitz_45nm")]
        assert list(map(float, row.split()[-4:-2])) == pytest.approx(sums, rel=1e-3)
        page = json.loads(page_of(server, "/usage.json?by=day"))
        assert (page["month"], page["rows"][0]["usage"]["decisions"]) == (month, "3")
        assert usage_of(server.admin, month="2001-01") == []
        for fields, part in (({"month": "2026-1"}, "month: expected one such as 2026-11"), ({"by": ["robot"]}, "by: ")):
            with fails_with(grpc.StatusCode.INVALID_ARGUMENT, part):
                server.admin.GetUsage(**fields)


def test_tenants_see_their_own_rows(tokens):
    with running_server(flags=[f"--tokens={tokens}", OFTEN, "--usage_metrics"]) as server:
        for token, steps in (("agent", 3), ("rival", 2)):
            with service_with(server, token) as service:
                play(service, steps)

        def seen_by(token):
            with service_with(server, token, ADMIN) as admin:
                return {row.tenant: row.usage.decisions for row in usage_of(admin, by=["tenant"])}

        until(lambda: seen_by("watchman") == {"fleet": 3, "rival": 2})
        assert seen_by("viewer") == {"fleet": 3}
        assert seen_by("rival-viewer") == {"rival": 2}
        with service_with(server, "agent", ADMIN) as admin:
            assert code_of(admin.GetUsage) == grpc.StatusCode.PERMISSION_DENIED
        page = json.loads(page_of(server, "/usage.json?by=tenant", "rival-viewer"))
        assert [row["tenant"] for row in page["rows"]] == ["rival"]
        assert http_call(server.http, "GET", "/usage.json")[0] == 401
        until(lambda: series(server, "spikeserve_tenant_month_decisions", "viewer", tenant="rival") == [2.0])
        drawn = set(re.findall(r"spikeserve_\w+", (DEPLOY / "grafana/spikeserve-month.json").read_text()))
        metrics = page_of(server, "/metrics", "viewer")
        assert drawn and all(f"# TYPE {name} gauge" in metrics for name in drawn)


def with_budgets(path, **budgets):
    tenants = {"fleet": {"budgets": budgets}, "rival": {}}
    kept = [each for each in TOKENS["tokens"] if each["tenant"] in tenants]
    path.write_text(json.dumps({"tenants": tenants, "tokens": [*kept, entry("extra", "agent")]}))


def test_a_spent_budget_refuses_new_sessions_until_it_is_raised(tmp_path):
    path = tmp_path / "tokens.json"
    log = tmp_path / "log"
    with_budgets(path, decisions=10, joules={"horowitz_45nm": 1.0})
    with running_server(flags=[f"--tokens={path}", OFTEN], log=log) as server:
        ratio = lambda: series(server, "spikeserve_budget_ratio", "viewer", budget="decisions")  # noqa: E731
        with service_with(server, "agent") as service, service_with(server, "rival") as rival:
            session = service.OpenSession(policy="cartpole").session_id
            steps = itertools.count()
            act = lambda: service.Act(session_id=session, step=next(steps), observation=OBSERVATION)  # noqa: E731
            for _ in range(8):
                act()
            until(lambda: ratio() == [0.8])
            assert "budget of a tenant is nearly spent" in log.read_text()
            for _ in range(3):
                act()
            until(lambda: code_of(service.OpenSession, policy="cartpole") == EXHAUSTED)
            year, month = time.gmtime()[:2]
            reset = f"{year + month // 12}-{month % 12 + 1:02}-01T00:00:00Z"
            with fails_with(EXHAUSTED, f"less than 10 of tenant fleet in this month, received 11; begins again at {reset}"):
                service.OpenSession(policy="cartpole")
            act()  # open sessions go on
            rival.OpenSession(policy="cartpole")
            with_budgets(path, decisions=10, open_sessions="stop")
            until(lambda: code_of(service.Act, session_id=session, observation=OBSERVATION) == EXHAUSTED)
            with_budgets(path, decisions=1000)
            until(lambda: code_of(service.OpenSession, policy="cartpole") == grpc.StatusCode.OK)
            act()
        lines = server.spikectl("usage", env=os.environ | {"SPIKESERVE_TOKEN": "viewer"}).stdout
        assert "budget of fleet: decisions" in lines
    assert "budget of a tenant is spent" in log.read_text()


@pytest.mark.parametrize(
    ("budgets", "part"),
    [
        ({"decisions": -1}, "budgets.decisions: expected a number of at least 0, received -1"),
        ({"joules": {"spike_5pj": 1}}, "budgets.joules: expected horowitz_45nm, int_45nm or int_sram_45nm"),
        ({"open_sessions": "wait"}, "open_sessions"),
    ],
)
def test_budgets_are_checked(budgets, part, tmp_path):
    with_budgets(tmp_path / "tokens.json", **budgets)
    assert part in refusal_at_start(f"--tokens={tmp_path}/tokens.json")


def test_flags_are_checked(tmp_path):
    assert "--usage_interval: expected at least 10ms" in refusal_at_start("--usage_interval=1ms")
    said = refusal_at_start(f"--usage_dir={tmp_path}", f"--session_store=file:{tmp_path}/store")
    assert "--usage_dir: expected none, because the ledger is in --session_store" in said
    with running_server(flags=[f"--usage_dir={tmp_path}/usage"]):
        assert "no other server uses" in refusal_at_start(f"--usage_dir={tmp_path}/usage")
