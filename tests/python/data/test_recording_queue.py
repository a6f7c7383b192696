"""What EndEpisode says about a recording is true, on a full disk, too."""

import subprocess

import pytest
from security import OBSERVATION, service_with, until
from serving import message_class, metric, running_server

STEPS = 200
LONGEST_FILE = 8192  # bytes; shorter than an episode of STEPS, longer than the log
EPISODES = 100


class Player:
    """Plays recorded episodes."""

    def __init__(self, server, record=True):
        self._policy = server.agent
        opened = self._policy.OpenSession(policy="cartpole-small", record=record)
        self._session = opened.session_id
        self.recording = opened.recording
        states = message_class(server.channel, "spikeserve.v1.EndEpisodeResponse").DESCRIPTOR
        self._states = states.fields_by_name["recording"].enum_type.values_by_number

    def play(self, steps=STEPS):
        items = [
            {"session_id": self._session, "step": step, "observation": OBSERVATION}
            for step in range(steps)
        ]
        for result in self._policy.ActBatch(requests=items).results:
            assert result.code == 0
        return self.end()

    def end(self):
        """Ends the episode, or asks again about the last one."""
        ended = self._policy.EndEpisode(session_id=self._session, terminated=True)
        return self._states[ended.recording].name


def test_stored_means_that_the_file_is_there(tmp_path):
    with running_server(flags=[f"--record_dir={tmp_path}"]) as addresses:
        player = Player(addresses)
        for episode in range(5):
            path = tmp_path / player.recording / f"{episode:06}.cbor"
            if player.play(steps=3) == "QUEUED":
                until(lambda: player.end() == "STORED")
            assert path.exists()
        until(lambda: metric(addresses, "spikeserve_recording_queue_episodes") == 0)
        assert metric(addresses, "spikeserve_recording_queue_bytes") == 0
        assert Player(addresses, record=False).play(steps=3) == "NOT_RECORDED"


@pytest.mark.parametrize("sessions", [1, 3])
def test_a_full_disk_is_one_line_in_the_log(tmp_path, sessions):
    records, log = tmp_path / "records", tmp_path / "log"
    prefix = ["prlimit", f"--fsize={LONGEST_FILE}:"]
    with running_server(flags=[f"--record_dir={records}"], log=log, prefix=prefix) as addresses:
        players = [Player(addresses) for _ in range(sessions)]
        for _ in range(EPISODES // sessions):
            for player in players:
                player.play()
        until(lambda: all(player.end() == "NOT_RECORDED" for player in players))
        assert list(records.rglob("*")) == []
        unlimited = "--fsize=unlimited:"
        subprocess.run(["prlimit", f"--pid={addresses.process.pid}", unlimited], check=True)
        players[0].play()
        until(lambda: players[0].end() == "STORED")
        assert len(list(records.rglob("*.cbor"))) == 1
    lines = log.read_text().splitlines()
    lost = EPISODES // sessions * sessions
    assert len([line for line in lines if "recordings are lost" in line]) == 1
    assert [line for line in lines if f'recordings are written again lost="{lost}"' in line]
    assert len(lines) == 2


LIMIT = 400_000  # bytes
SHARED_STEPS = 50
NOT_RECORDED = 0


def played(service):
    """Plays a recorded episode in a new session. Returns its state."""
    session = service.OpenSession(policy="cartpole", record=True).session_id
    acts = [{"session_id": session, "step": step, "observation": OBSERVATION} for step in range(SHARED_STEPS)]
    service.ActBatch(requests=acts)
    state = service.EndEpisode(session_id=session, terminated=True).recording
    service.CloseSession(session_id=session)
    return state


def test_a_tenant_leaves_others_their_share_of_the_disk(tmp_path, tokens):
    log = tmp_path / "log"
    flags = [f"--tokens={tokens}", f"--record_dir={tmp_path}/records", f"--max_recorded_bytes={LIMIT}"]
    with (
        running_server(flags=flags, log=log) as addresses,
        service_with(addresses, "agent") as greedy,
        service_with(addresses, "rival") as neighbour,
    ):
        recorded = 0
        while played(greedy) != NOT_RECORDED:
            recorded += 1
            assert recorded * SHARED_STEPS * 20 < LIMIT
        assert recorded > 10
        assert all(played(neighbour) != NOT_RECORDED for _ in range(recorded // 4))
        assert played(greedy) == NOT_RECORDED
    text = log.read_text()
    assert "episode not recorded" in text and 'tenant="fleet"' in text and 'tenant="rival"' not in text


def test_what_is_on_the_disk_is_counted_at_the_start(tmp_path):
    (tmp_path / "older").mkdir()
    (tmp_path / "older" / "000000.cbor").write_bytes(bytes(LIMIT))
    with running_server(flags=[f"--record_dir={tmp_path}", f"--max_recorded_bytes={LIMIT}"]) as addresses:
        assert metric(addresses, "spikeserve_stored_bytes", folder="recordings") == LIMIT
        assert metric(addresses, "spikeserve_stored_bytes_limit", folder="recordings") == LIMIT
        with service_with(addresses, None) as service:
            assert played(service) == NOT_RECORDED
        assert metric(addresses, "spikeserve_recorded_episodes_total", outcome="storage_full") == 1
