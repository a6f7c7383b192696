"""A recording that rosbag2 has split into files is one episode."""

import pytest
import robot_data
from spikeserve.conversion import Selection
from spikeserve.conversion.converting import read

STEPS = 24
SELECTION = Selection(("/state", "/goal"), "/command", "/reward")
LISTED = "rosbag2_bagfile_information:\n  version: 9\n  relative_file_paths:\n{}  duration:\n    nanoseconds: 1\n"


def record(folder, files, listed=None):
    """Writes what rosbag2 writes: NAME_0.mcap, NAME_1.mcap, ... The latched goal is in the first file only."""
    folder.mkdir(parents=True)
    names = [f"{folder.name}_{n}.mcap" for n in range(files)]
    for n, name in enumerate(names):
        steps = range(n * STEPS // files, (n + 1) * STEPS // files)
        log = {
            "/state": [(1 + k / 50, {"v": [float(k)]}) for k in steps],
            "/command": [(1 + k / 50 + 0.001, {"u": [0.1 * k]}) for k in steps],
            "/reward": [(1 + k / 50 + 0.01, {"r": 1.0}) for k in steps],
        }
        if n == 0:
            log["/goal"] = [(0.5, {"x": 3.0})]
        robot_data.write_json_log(folder / name, log)
    paths = names if listed is None else listed
    (folder / "metadata.yaml").write_text(LISTED.format("".join(f"    - {name}\n" for name in paths)))
    return folder


def states(episode):
    return episode.observations[:-1, 0].tolist()


@pytest.mark.parametrize("files", [1, 12])
def test_a_split_recording_is_one_episode(files, tmp_path):
    record(tmp_path / "drive", files)
    (episode,) = read(tmp_path / "drive", selection=SELECTION).episodes
    assert states(episode) == list(range(STEPS))
    assert episode.observations[:-1, 1].tolist() == [3.0] * STEPS
    assert episode.rewards.sum() == STEPS


def test_each_recording_of_a_folder_is_an_episode(tmp_path):
    record(tmp_path / "drives/b", 12)
    record(tmp_path / "drives/a", 3)
    episodes = read(tmp_path / "drives", selection=SELECTION).episodes
    assert [states(episode) for episode in episodes] == [list(range(STEPS))] * 2


def test_the_order_is_that_of_the_metadata_and_of_time(tmp_path):
    names = ["drive_1.mcap", '"drive_0.mcap"', "drive/drive_2.mcap"]  # as other versions write them
    record(tmp_path / "drive", 3, names)
    (episode,) = read(tmp_path / "drive", selection=SELECTION).episodes
    assert states(episode) == list(range(STEPS))


BROKEN = {
    "missing": (["drive_0.mcap", "drive_1.mcap", "drive_2.mcap"], "expected the file drive_2.mcap, received none"),
    "more": (["drive_0.mcap"], "drive_1.mcap: expected a file that "),
    "compressed": (["drive_0.mcap.zstd"], r"expected files \*.mcap; `ros2 bag convert` writes them, received drive_0"),
    "none": ([], "metadata.yaml: expected relative_file_paths, a list of files, received none"),
}


@pytest.mark.parametrize(("listed", "reason"), BROKEN.values(), ids=BROKEN)
def test_a_recording_that_is_not_whole_is_refused(listed, reason, tmp_path):
    record(tmp_path / "drive", 2, listed)
    with pytest.raises(ValueError, match=reason):
        read(tmp_path / "drive", selection=SELECTION)


def test_files_without_metadata_are_episodes_in_the_order_of_their_numbers(tmp_path):
    record(tmp_path / "drive", 12)
    (tmp_path / "drive/metadata.yaml").unlink()
    data = read(tmp_path / "drive", selection=Selection(("/state",), "/command"))
    assert [episode.observations[0][0] for episode in data.episodes] == [2.0 * n for n in range(12)]
    assert any("`ros2 bag reindex`" in note for note in data.notes)


def test_a_part_says_that_there_are_others(tmp_path):
    record(tmp_path / "drive", 3)
    data = read(tmp_path / "drive/drive_1.mcap", selection=Selection(("/state",), "/command"))
    assert len(data.episodes) == 1
    assert any("one of 3 files of a recording" in note for note in data.notes)
