"""The C++ client and its programs on three replicas: the tests of the Python client, and the same answers."""

import asyncio
import os
import signal
import subprocess

import pytest
from replicated import observation, options_of, policy_of, reward, running_fleet
from security import until
from serving import DEADLINE_SECONDS, run, running_server, series
from spikeserve.values import Decision, EpisodeSummary, SessionState
from spikeserve.wire import message_class
from test_replicas import (  # noqa: F401
    Calls,
    Streams,
    disturbing,
    fleet,
    play,
    pytestmark,
    test_a_rolling_restart,
    test_calls_beside_a_stream_stay_with_it,
    test_every_replica_is_killed,
    test_every_replica_is_stopped,
    test_redis_is_killed,
    test_the_state_of_a_session_whose_episode_ended_elsewhere,
    test_what_the_store_misses_is_sent_again,
    test_without_a_disturbance,
    undisturbed,
)


class CppCalls(Calls):
    """Plays with tests/integration/client_player.cc. A session is its number."""

    mode = "calls"
    more = ()  # arguments

    def __init__(self, client):
        super().__init__(client)
        self.closed = set()
        self.ids = {}
        self.player = subprocess.Popen(
            [os.environ["CLIENT_PLAYER_PROGRAM"], client.server, self.mode, *self.more],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, answer, *words):
        """Sends one line and returns its answer as a message of the wire contract."""
        print(*words, file=self.player.stdin, flush=True)
        line = self.player.stdout.readline().strip()
        assert line and not line.startswith("error"), line
        return None if answer is None else message_class(answer).FromString(bytes.fromhex(line))

    async def open(self, i, durability):
        request = options_of(i, durability).to_wire(policy_of(i))
        opened = self.ask("OpenSessionResponse", "open", request.SerializeToString().hex())
        assert opened.durability > 0
        self.ids[i] = opened.session_id
        return i

    async def act_all(self, sessions, t):
        requests = message_class("ActBatchRequest")()
        for i in sessions:
            requests.requests.add(observation=observation(i, t), reward=reward(t))
        answers = self.ask("ActBatchResponse", "act", requests.SerializeToString().hex())
        return [Decision.from_wire(result.response) for result in answers.results]

    async def end(self, session, i):
        request = message_class("EndEpisodeRequest")(reward=1.0 + i, terminated=True)
        ended = self.ask("EndEpisodeResponse", "end", i, request.SerializeToString().hex())
        return EpisodeSummary.from_wire(ended)

    async def state(self, session):
        return SessionState.from_wire(self.ask("GetSessionResponse", "state", session))

    async def close(self, session):
        if session not in self.closed:  # play() closes twice
            print("close", session, file=self.player.stdin, flush=True)
            assert self.player.stdout.readline() == "ok\n"
            self.closed.add(session)

    def id_of(self, session):
        return self.ids[session]

    def leave(self):
        self.player.stdin.close()
        self.player.stdout.close()
        assert self.player.wait(timeout=DEADLINE_SECONDS) == 0


class CppBatches(CppCalls):
    """Plays with Client::ActBatch."""

    mode = "batch"


class CppStreams(CppCalls):
    """Plays on one RemoteStream."""

    mode = "stream"


@pytest.fixture(params=[CppCalls, CppBatches, CppStreams], ids=lambda player: player.__name__)
def disturbed(fleet, undisturbed, request):  # noqa: F811
    yield from disturbing(fleet, undisturbed, request.param)


@pytest.fixture
def streams():
    return CppStreams


@pytest.fixture
def calls():
    return CppCalls


def spikectl(server, *flags):
    """Starts `spikectl run` at the servers."""
    command = [os.environ["SPIKECTL_PROGRAM"], "run", "--env=CartPole-v1", "--episodes=30", *flags]
    environment = os.environ | {"SPIKESERVE_SERVER": server}
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def played(program, disturb=lambda line: None):
    """Returns the lines of a `spikectl run`: the seed, return, steps and spikes of each episode."""
    lines = []
    for line in program.stdout:
        disturb(len(lines))
        lines.append(line.split()[:4])
    program.stdout.close()
    assert program.wait(timeout=DEADLINE_SECONDS) == 0
    return lines[2:32]  # without the head and the summary


@pytest.mark.parametrize("durability", ["async", "sync"])
def test_spikectl_run_goes_on(fleet, durability):  # noqa: F811
    first, second, third = fleet.replicas
    disturbances = {
        2: first.kill,
        8: lambda: (first.start(), second.kill()),
        14: lambda: (second.start(), third.kill()),
        20: third.start,
    }
    with running_server() as server:
        undisturbed = played(spikectl(server.grpc, "--durability=none"))
    assert len(undisturbed) == 30
    program = spikectl(fleet.addresses, f"--durability={durability}")
    assert played(program, lambda line: disturbances.get(line, lambda: None)()) == undisturbed


def test_spikectl_refuses_a_durability_without_a_store():
    with running_server() as server:
        assert "durability: expected NONE" in server.spikectl("run", "--durability=sync", status=1).stderr
        refused = server.spikectl("run", "--durability=ever", status=1)
        assert "--durability: expected none, async or sync" in refused.stderr


def test_operators_reach_any_server(fleet):  # noqa: F811
    """Whichever server cannot be reached: one answers for all, or all but this one do."""
    command = [os.environ["SPIKECTL_PROGRAM"], f"--server={fleet.addresses}"]
    for replica in fleet.replicas:
        replica.kill()
        run(*command, "policies")
        listed = run(*command, "admin", "sessions", status=1)
        replica.start()
        assert f"1 of 3 servers failed: {replica.address}" in listed.stderr


@pytest.fixture(scope="module")
def quick_fleet():
    """Its Redis does not wait for a disk, so it keeps pace with spikeload."""
    with running_fleet(redis_flags=()) as started:
        yield started


@pytest.mark.parametrize("mode", ["unary", "stream", "batch"])
@pytest.mark.parametrize("durability", ["none", "async", "sync"])
def test_spikeload_uses_all_servers(quick_fleet, mode, durability):
    command = [os.environ["SPIKELOAD_PROGRAM"], f"--server={quick_fleet.addresses}", f"--mode={mode}"]
    flags = [f"--durability={durability}", "--sessions=32", "--duration=1s", "--episode_steps=10"]
    assert "\n0 errors\n" in run(*command, *flags).stdout


def test_spikeload_with_retries_sees_only_waits(fleet):  # noqa: F811
    """Every replica is restarted while it plays."""
    command = [os.environ["SPIKELOAD_PROGRAM"], f"--server={fleet.addresses}", "--mode=stream", "--retry"]
    flags = ["--sessions=16", "--streams=8", "--duration=5s", "--episode_steps=50"]
    load = subprocess.Popen([*command, *flags], stdout=subprocess.PIPE, text=True)
    for replica in fleet.replicas:
        replica.restart()
    printed, _ = load.communicate(timeout=DEADLINE_SECONDS)
    assert load.returncode == 0 and "\n0 errors\n" in printed, printed


@pytest.mark.parametrize("mode, method", [("unary", "Act"), ("stream", "ActStream")])
def test_spikeload_with_retries_waits_for_the_store(mode, method):
    """Redis stands still until the server refuses decisions that it cannot store."""

    def answered(code):
        return series(replica.server, "spikeserve_rpc_duration_seconds_count", code=code, method=method)

    with running_fleet(replicas=1, http=True, redis_flags=()) as fleet:
        [replica] = fleet.replicas
        command = [os.environ["SPIKELOAD_PROGRAM"], f"--server={fleet.addresses}", f"--mode={mode}", "--retry"]
        flags = ["--sessions=4", "--streams=2", "--duration=5s"]
        load = subprocess.Popen([*command, *flags], stdout=subprocess.PIPE, text=True)
        until(lambda: answered("OK"))
        fleet.redis.process.send_signal(signal.SIGSTOP)
        until(lambda: answered("UNAVAILABLE"))
        fleet.redis.process.send_signal(signal.SIGCONT)
        printed, _ = load.communicate(timeout=DEADLINE_SECONDS)
        assert load.returncode == 0 and "\n0 errors\n" in printed, printed


def test_unix_sockets(tmp_path, undisturbed):  # noqa: F811
    """An address of a client may be a socket of the file system, and one of several."""
    path = f"unix:{tmp_path}/server.sock"
    with running_server(flags=[f"--listen={path}"]) as server:
        assert server.grpc == path
        for player in (Calls, Streams, CppCalls, CppStreams):
            assert asyncio.run(play(path, player, "NONE")) == undisturbed
        for player in (Calls, CppCalls):
            several = f"unix:{tmp_path}/none.sock,{path}"
            assert asyncio.run(play(several, player, "NONE")) == undisturbed


@pytest.mark.parametrize("player", [Calls, Streams, CppCalls, CppStreams], ids=lambda p: p.__name__)
def test_a_maximum_connection_age_is_not_noticed(player, undisturbed):  # noqa: F811
    """The server asks for new connections all the time."""
    with running_server(flags=["--max_connection_age=100ms"]) as server:
        assert asyncio.run(play(server.grpc, player, "NONE")) == undisturbed
