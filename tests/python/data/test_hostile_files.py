"""Files of strangers take no more memory than their size allows, end no process, and show no other file."""

import json
import os
import subprocess
import sys

import h5py
import minari
import numpy as np
import pyarrow as pa
import pytest
import robot_data
from gymnasium import spaces
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from pyarrow import parquet
from spikeserve.conversion import Selection, child, convert
from spikeserve.conversion.converting import read
from spikeserve.imitation.datasets import open_dataset
from serving import run

MIB = 1 << 20
FITS = r"source: expected data that fit into (6[4-9]|7\d|8\d) MiB, received more"


@pytest.fixture(autouse=True)
def little_memory(monkeypatch):
    """Lets any file take 64 MiB."""
    monkeypatch.setattr(child, "LEAST_BYTES", 64 * MIB)


def test_a_small_log_does_not_become_gigabytes(tmp_path):
    path = tmp_path / "bomb.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, chunk_size=1 << 30)
        writer.start()
        schema = writer.register_schema("s", "jsonschema", b"{}")
        channels = [writer.register_channel(topic, "json", schema) for topic in ("/state", "/command")]
        zeros = b'{"v": [' + b"0," * (8 * MIB) + b"0]}"
        for channel in channels:
            writer.add_message(channel, 1, zeros, 1)
        writer.finish()
    assert path.stat().st_size < MIB
    with pytest.raises(ValueError, match=FITS):
        read(path, selection=Selection(observation=("/state",), action="/command"))


def test_a_small_table_does_not_become_gigabytes(tmp_path):
    robot_data.write_lerobot(tmp_path / "set")
    path = tmp_path / "set/data/chunk-000/file-001.parquet"
    frames = 6 * MIB
    whole = pa.array(np.zeros(frames, np.int64))
    floats = pa.array(np.zeros(2 * frames, np.float64))
    pairs = pa.FixedSizeListArray.from_arrays(floats, 2)
    names = ("frame_index", "episode_index", "index", "task_index")
    columns = {"action": pairs, "observation.state": pairs, "observation.extra": floats.slice(0, frames)}
    parquet.write_table(pa.table(columns | {name: whole for name in names}), path, compression="zstd")
    with pytest.raises(ValueError, match=FITS):
        read(tmp_path / "set")


def test_a_crash_of_a_library_is_an_error(tmp_path, monkeypatch):
    robot_data.write_lerobot(tmp_path / "set")
    monkeypatch.setattr(child, "_limit", lambda _: os.kill(os.getpid(), 11))
    with pytest.raises(ValueError, match=r"received some that ended the process which read them \(status -11\)"):
        read(tmp_path / "set")


def minari_set(folder):
    (folder / "data").mkdir(parents=True)
    space = spaces.Box(-1, 1, (3,), np.float32)
    storage = MinariStorage.new(folder / "data", observation_space=space, action_space=spaces.Discrete(2))
    ends = [False, True]
    episode = EpisodeBuffer(0, 0, None, [space.sample() for _ in range(3)], [0, 1], [1.0] * 2, ends, [False] * 2)
    storage.update_episodes([episode])
    storage.update_metadata({"dataset_id": folder.name, "minari_version": minari.__version__})
    return folder


def external(file, secret):
    del file["episode_0/observations"]
    shape, dtype = (3, 3), np.float32
    file.create_dataset("episode_0/observations", shape, dtype, external=[(str(secret), 0, 36)])


def virtual(file, secret):
    del file["episode_0/observations"]
    with h5py.File(secret.with_suffix(".h5"), "w") as other:
        other["x"] = np.zeros((3, 3), np.float32)
    layout = h5py.VirtualLayout((3, 3), np.float32)
    layout[:] = h5py.VirtualSource(str(secret.with_suffix(".h5")), "x", (3, 3))
    file.create_virtual_dataset("episode_0/observations", layout)


def link(file, secret):
    del file["episode_0/observations"]
    with h5py.File(secret.with_suffix(".h5"), "w") as other:
        other["x"] = np.zeros((3, 3), np.float32)
    file["episode_0/observations"] = h5py.ExternalLink(str(secret.with_suffix(".h5")), "/x")


def link_by_name(file, secret):
    link(file, secret)
    file.move("episode_0/observations", "far")
    file["episode_0/observations"] = h5py.SoftLink("/far")


OTHERS = {
    "external": (external, "external storage"),
    "virtual": (virtual, "a virtual dataset"),
    "link": (link, "ExternalLink"),
    "link by name": (link_by_name, "(Soft|External)Link"),
}


@pytest.fixture(params=OTHERS.values(), ids=OTHERS)
def prying(request, tmp_path):
    """Returns a data set that shows another file of the machine as its observations, and how it does so."""
    change, kind = request.param
    secret = tmp_path / "secret"
    secret.write_bytes(np.arange(9, dtype=np.float32).tobytes())
    folder = minari_set(tmp_path / "set-v0")
    with h5py.File(folder / "data/main_data.hdf5", "r+") as file:
        change(file, secret)
    return folder, kind


def test_hdf5_does_not_show_other_files(prying, monkeypatch):
    folder, kind = prying
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder.parent))
    for opening in (read, open_dataset, lambda folder: open_dataset(folder.name)):
        with pytest.raises(ValueError, match=f"(episode_0/observations|far): expected .* received {kind}"):
            opening(folder)


def test_spiketrain_does_not_read_other_files(prying, tmp_path):
    if "SPIKETRAIN_PROGRAM" not in os.environ:
        pytest.skip("the build has no spiketrain")
    folder, _ = prying
    trained = run("spiketrain", "train", f"--data={folder}", f"--out={tmp_path}/out", status=1)
    assert "episode_0/observations: expected numbers in this file, received those of another one" in trained.stderr


LOOPS = {
    "root": lambda file: file.__setitem__("episode_0/infos", file["/"]),
    "tree": lambda file: [file.require_group("episode_0/infos").__setitem__(k, file["episode_0/infos"]) for k in "ab"],
    "soft": lambda file: file.__setitem__("episode_0/infos", h5py.SoftLink("/")),
}


@pytest.mark.parametrize("loop", LOOPS.values(), ids=LOOPS)
def test_groups_within_themselves_are_refused(loop, tmp_path):
    folder = minari_set(tmp_path / "set-v0")
    with h5py.File(folder / "data/main_data.hdf5", "r+") as file:
        loop(file)
    with pytest.raises(ValueError, match="expected numbers in this file, received (a group that has two names|SoftLink)"):
        read(folder)


def test_a_small_hdf5_file_does_not_become_gigabytes(tmp_path):
    """`imitate` reads it without a child process."""
    folder = minari_set(tmp_path / "set-v0")
    with h5py.File(folder / "data/main_data.hdf5", "r+") as file:
        del file["episode_0/rewards"]
        file.create_dataset("episode_0/rewards", (1 << 33,), "f8", chunks=(1 << 20,), compression="gzip")
    for opening in (read, open_dataset):
        with pytest.raises(ValueError, match=r"episode_0/rewards: expected .* received more than 10\d\d MiB"):
            opening(folder)


@pytest.mark.parametrize("fps", ["Infinity", "NaN", "-1", "1e-300", '"x"', "[]"])
def test_the_rate_of_a_log_is_a_rate(fps, tmp_path):
    robot_data.write_recording(tmp_path / "0.cbor", [([[0.5]] * 3, [0, 1], [1.0] * 2)], {"n": 2})
    convert(tmp_path / "0.cbor", tmp_path / "logs", "mcap")
    (log,) = (tmp_path / "logs").iterdir()
    with pytest.raises(ValueError, match="fps: expected a number from 1e-06 to 1e"):
        convert(with_metadata(log, tmp_path / "log.mcap", fps=fps), tmp_path / "set", "lerobot")


def with_metadata(log, copy, **metadata):
    """Writes a log again, with other metadata. Returns the copy."""
    with log.open("rb") as file, copy.open("wb") as out:
        reader, writer = make_reader(file), Writer(out)
        writer.start()
        channels = {}
        for schema, channel, message in reader.iter_messages():
            if channel.topic not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "json", schema_id)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.log_time)
        (known,) = reader.iter_metadata()
        writer.add_metadata(known.name, known.metadata | metadata)
        writer.finish()
    return copy


def test_names_in_files_do_not_reach_the_terminal_raw(tmp_path):
    robot_data.write_json_log(tmp_path / "log.mcap", {"/a\x1b]52;c;aGk=\x07\r": [(0, {"v": [1.0]})]})
    command = [sys.executable, "-m", "spikeserve", "convert", tmp_path / "log.mcap", tmp_path / "out", "--to=lerobot"]
    done = subprocess.run(command, capture_output=True)
    assert (done.returncode, done.stdout) == (1, b"")
    assert "a topic of the log (/a\\u001b]52;c;aGk=\\u0007\\u000d)" in done.stderr.decode()
    assert done.stderr.decode().removesuffix("\n").isprintable()


def test_an_environment_that_is_none_of_gymnasium_is_kept(tmp_path):
    episode = ([[0.5]] * 3, [0, 1], [1.0] * 2)
    robot_data.write_recording(tmp_path / "0.cbor", [episode], {"n": 2}, environment="my robot")
    convert(tmp_path / "0.cbor", tmp_path / "set-v0", "minari")
    assert read(tmp_path / "set-v0").environment == "my robot"


def test_what_is_read_in_a_child_is_the_same(tmp_path):
    served = ([[0.5, 1.5]] * 4, [[0.1], [0.2], [0.3]], [1.0, 2.0, 3.0])
    robot_data.write_recording(tmp_path / "0.cbor", [served], {"low": [0.0], "high": [1.0]}, served=True)
    (episode,) = read(tmp_path / "0.cbor").episodes
    assert episode.served["labels"] == {"robot": "7"}
    assert episode.actions.dtype == np.float32 and episode.rewards.dtype == np.float64
    assert json.dumps(dict(episode.served))
