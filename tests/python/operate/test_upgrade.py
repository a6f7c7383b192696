"""A server continues with the files of former releases, which tests/releases has."""

import json
import os
import shutil
import subprocess

import pytest
from redis_servers import WITHOUT_REDIS
from release_files import RELEASES, SESSIONS, assert_contains, play_second_half, server_on
from serving import running_server

KINDS = ["file", pytest.param("redis", marks=WITHOUT_REDIS)]
FOLDERS = sorted(path for path in RELEASES.iterdir() if path.is_dir())
BEFORE = FOLDERS[-1]  # the release before


def copy_of(release, kind, folder):
    """Copies what the server of a release left behind."""
    shutil.copytree(release / "policies", folder / "policies")
    return shutil.copytree(release / kind, folder / kind)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("release", FOLDERS, ids=lambda folder: folder.name)
def test_sessions_and_settings_go_on_after_an_upgrade(release, kind, tmp_path):
    state = copy_of(release, kind, tmp_path)
    history = (state / "audit.jsonl").read_text()
    with server_on(state) as (service, admin):
        assert_contains(play_second_half(service, admin), json.loads((state / "answers.json").read_text()))
        admin.RemoveLabel(policy="cartpole-sparse", label="stable")
    assert (state / "audit.jsonl").read_text().startswith(history)
    assert "RemoveLabel" in (state / "audit.jsonl").read_text().removeprefix(history)


@pytest.mark.parametrize("release", FOLDERS, ids=lambda folder: folder.name)
def test_recordings_replay_after_an_upgrade(release, tmp_path):
    state = copy_of(release, "file", tmp_path)
    recordings = sorted((state / "recordings").iterdir())
    assert len(recordings) == SESSIONS
    with running_server(state.parent / "policies") as addresses:
        finished = [
            subprocess.run(
                [os.environ["SPIKECTL_PROGRAM"], "replay", f"--recording={recording}", f"--server={addresses.grpc}"],
                capture_output=True,
                text=True,
            )
            for recording in recordings
        ]
    # Sessions that learned cannot be replayed by any release.
    outcomes = ["learned" if "received one that learned" in run.stderr else run.stdout + run.stderr for run in finished]
    assert outcomes.count("learned") == SESSIONS / 2
    for outcome in outcomes:
        assert outcome == "learned" or "all equal bit for bit" in outcome


def test_settings_of_a_later_release_are_refused_by_name(tmp_path):
    """A server that does not know a setting does not start, instead of dropping it."""
    state = copy_of(BEFORE, "file", tmp_path)
    settings = json.loads((state / "settings.json").read_text())
    settings["policies"]["cartpole-sparse"]["of_a_later_release"] = 1
    (state / "settings.json").write_text(json.dumps(settings))
    refused = subprocess.run(
        [
            *(os.environ["SPIKESERVE_PROGRAM"], f"--policies={tmp_path}/policies", "--listen=127.0.0.1:0"),
            *("--http_listen=", f"--policy_settings={state}/settings.json"),
        ],
        capture_output=True,
        text=True,
    )
    assert refused.returncode != 0
    assert "of_a_later_release" in refused.stderr
