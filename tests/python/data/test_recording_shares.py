"""Recordings of one tenant leave room for those of others, on the disk, too, and the figures and the log say so."""

from security import OBSERVATION, service_with
from serving import metric, running_server

LIMIT = 400_000  # bytes
STEPS = 50
NOT_RECORDED = 0


def played(service):
    """Plays a recorded episode in a new session. Returns its state."""
    session = service.OpenSession(policy="cartpole", record=True).session_id
    acts = [{"session_id": session, "step": step, "observation": OBSERVATION} for step in range(STEPS)]
    service.ActBatch(requests=acts)
    state = service.EndEpisode(session_id=session, terminated=True).recording
    service.CloseSession(session_id=session)
    return state


def test_a_tenant_leaves_others_their_share_of_the_disk(tmp_path, tokens):
    log = tmp_path / "log"
    flags = [f"--tokens={tokens}", f"--record_dir={tmp_path}/records", f"--max_recorded_bytes={LIMIT}"]
    with (
        log.open("w") as file,
        running_server(flags=flags, log=file) as addresses,
        service_with(addresses, "agent") as greedy,
        service_with(addresses, "rival") as neighbour,
    ):
        recorded = 0
        while played(greedy) != NOT_RECORDED:
            recorded += 1
            assert recorded * STEPS * 20 < LIMIT
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
