"""A server continues with the files of former releases, which tests/releases has."""

import json
import shutil

import grpc
import pytest
from redis_servers import WITHOUT_REDIS
from release_files import RELEASES, SESSIONS, assert_contains, convert_int8, decide, opening, play_second_half, server_on
from security import fails_with
from serving import refusal_at_start, running_server

KINDS = ["file", pytest.param("redis", marks=WITHOUT_REDIS)]
FOLDERS = sorted(path for path in RELEASES.iterdir() if path.is_dir())
BEFORE = FOLDERS[-1]  # the release before


def copy_of(release, kind, folder):
    """Copies what the server of a release left behind."""
    shutil.copytree(release / "policies", folder / "policies")
    state = shutil.copytree(release / kind, folder / kind)
    shutil.unpack_archive(state / "recordings.tar", state)
    return state


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("release", FOLDERS, ids=lambda folder: folder.name)
def test_sessions_and_settings_go_on_after_an_upgrade(release, kind, tmp_path):
    state = copy_of(release, kind, tmp_path)
    history = (state / "audit.jsonl").read_text()
    converted = convert_int8(tmp_path / "policies")
    expected = json.loads((state / "answers.json").read_text())
    for policy in expected["policies"]["policies"]:
        if (policy["name"], policy["version"]) in converted:
            del policy["training_return"]  # of the file before
    views = [expected[opening(i)["session_id"]][-1] for i in range(SESSIONS)]
    ended = [i for i, view in enumerate(views) if (view["policy"], view["version"]) in converted]
    for i in ended:  # their file is another one now
        del expected[opening(i)["session_id"]]
    with server_on(state) as (service, admin):
        goes_on = [i for i in range(SESSIONS) if i not in ended]
        assert_contains(play_second_half(service, admin, goes_on), expected)
        for i in ended:
            with fails_with(grpc.StatusCode.UNAVAILABLE, "whose file is another one here"):
                decide(service, opening(i)["session_id"], 23, 13)
        admin.RemoveLabel(policy="cartpole-sparse", label="stable")
    assert len(ended) == SESSIONS / 2
    assert (state / "audit.jsonl").read_text().startswith(history)
    assert "RemoveLabel" in (state / "audit.jsonl").read_text().removeprefix(history)


@pytest.mark.parametrize("release", FOLDERS, ids=lambda folder: folder.name)
def test_a_file_in_int8_is_refused_with_the_command_that_converts_it(release, tmp_path):
    shutil.copytree(release / "policies/cartpole-frugal", tmp_path / "policies/cartpole-frugal")
    said = refusal_at_start(policies=tmp_path / "policies")  # beside others, it is logged
    assert "policy.safetensors: config.arithmetic: expected float32 or integer, received int8" in said
    assert "`spiketrain quantize --policy=OLD --out=NEW` converts the file" in said


@pytest.mark.parametrize("release", FOLDERS, ids=lambda folder: folder.name)
def test_recordings_replay_after_an_upgrade(release, tmp_path):
    state = copy_of(release, "file", tmp_path)
    convert_int8(tmp_path / "policies")
    recordings = sorted((state / "recordings").iterdir())
    assert len(recordings) == SESSIONS
    with running_server(state.parent / "policies") as addresses:
        finished = [
            addresses.spikectl("replay", f"--recording={recording}", status=None) for recording in recordings
        ]
    # Sessions that learned cannot be replayed by any release.
    outcomes = ["learned" if "received one that learned" in run.stderr else run.stdout + run.stderr for run in finished]
    assert outcomes.count("learned") == SESSIONS / 2
    for outcome in outcomes:
        assert outcome == "learned" or "all equal bit for bit" in outcome


def test_settings_of_a_later_release_are_refused_by_name(tmp_path):
    """A server that does not know a setting does not start, instead of dropping it."""
    state = copy_of(BEFORE, "file", tmp_path)
    convert_int8(tmp_path / "policies")
    settings = json.loads((state / "settings.json").read_text())
    settings["policies"]["cartpole-sparse"]["of_a_later_release"] = 1
    (state / "settings.json").write_text(json.dumps(settings))
    said = refusal_at_start(f"--policy_settings={state}/settings.json", policies=tmp_path / "policies")
    assert "of_a_later_release" in said
