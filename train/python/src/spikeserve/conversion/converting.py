"""`convert`: reads data of one format and writes it in another."""

from __future__ import annotations

import contextlib
import pathlib
import shutil
import tempfile
from collections.abc import Iterator

from spikeserve.check import check
from spikeserve.conversion import lerobot_layout, mcap_layout, minari_files, recordings
from spikeserve.conversion.child import read_in_child
from spikeserve.conversion.data import RobotData, Selection, check_names
from spikeserve.conversion.lerobot_reader import read_lerobot
from spikeserve.conversion.lerobot_writer import write_lerobot
from spikeserve.conversion.mcap_reader import read_mcap
from spikeserve.conversion.mcap_writer import write_mcap
from spikeserve.conversion.minari_files import read_minari, write_minari
from spikeserve.conversion.recordings import read_recordings, write_cbor

FORMATS = ("lerobot", "mcap", "minari", "spikeserve")
_READERS = {
    "lerobot": read_lerobot,
    "mcap": read_mcap,
    "minari": read_minari,
    "spikeserve": read_recordings,
}
# Formats that do not show which numbers are an observation or an action.
_SELECTABLE = ("lerobot", "mcap")
_SLOWEST, _FASTEST = 1e-6, 1e6  # steps a second


def format_of(path: pathlib.Path) -> str | None:
    """Returns the format of a file or folder, by its names; None: of no known format."""
    if path.is_file():
        return {recordings.SUFFIX: "spikeserve", mcap_layout.SUFFIX: "mcap"}.get(path.suffix)
    if (path / lerobot_layout.INFO).is_file():
        return "lerobot"
    if (path / minari_files.METADATA).is_file():
        return "minari"
    if any(path.rglob(f"*{mcap_layout.SUFFIX}")):
        return "mcap"
    return "spikeserve" if any(path.rglob(f"*{recordings.SUFFIX}")) else None


def read(
    source: str | pathlib.Path, form: str | None = None, selection: Selection | None = None
) -> RobotData:
    """Reads a file or folder. `form` is one of FORMATS; None: as its names tell.

    ValueError, which names the file, the column or topic, the expected and the received. A child
    process with limits reads, because untrusted files may crash or bloat it.
    """
    path, selection = pathlib.Path(source), selection or Selection()
    check(path.exists(), "source", "a file or folder", f"{source}, which does not exist")
    form = form or format_of(path)
    check(form in FORMATS, "source", f"one of {', '.join(FORMATS)}", f"{source} of another format")
    assert form is not None
    if form not in _SELECTABLE:
        declared = f"none, because {form} declares it"
        for flag, value in (
            ("--observation", selection.observation),
            ("--action", selection.action),
            ("--reward", selection.reward),
            ("--actions", selection.actions),
            ("--action-low", selection.action_low),
            ("--action-high", selection.action_high),
        ):
            check(not value, flag, declared, value)
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    reader = _READERS[form]
    data = read_in_child(lambda: reader(path, selection), sum(f.stat().st_size for f in files))
    name = data.environment
    named = isinstance(name, str) and name != "" and name.isprintable()
    check(named, f"{source}: environment", "a printable name", repr(name))
    fps = data.fps
    usable = fps is None or (type(fps) in (int, float) and _SLOWEST <= fps <= _FASTEST)
    check(usable, f"{source}: fps", f"a number from {_SLOWEST:g} to {_FASTEST:g}", fps)
    check_names(data, str(source))
    for episode in data.episodes:
        episode.task = selection.task or episode.task
    return data


def convert(
    source: str | pathlib.Path,
    out: str | pathlib.Path,
    to: str,
    *,
    source_format: str | None = None,
    selection: Selection | None = None,
    overwrite: bool = False,
) -> RobotData:
    """Reads `source` and writes it to `out` in the format `to`, one of FORMATS.

    `out` is a folder, or a .cbor file for `spikeserve`. It appears when it is complete. ValueError
    if it exists, unless `overwrite` replaces data of the same format. Returns what was written.
    """
    check(to in FORMATS, "--to", f"one of {', '.join(FORMATS)}", to)
    target = pathlib.Path(out).absolute()
    if to == "spikeserve":
        suffix = recordings.SUFFIX
        check(target.suffix == suffix, "out", f"a file {suffix} for spikeserve", out)
    if target.exists():
        check(overwrite, "out", "a path that does not exist, or --overwrite", out)
        same = format_of(target) == to
        check(same, "out", f"data in the format {to}, which --overwrite replaces", out)
    data = read(source, source_format, selection)
    if to in _SELECTABLE and any(episode.labels is not None for episode in data.episodes):
        data.notes.append(f"left out: the labels, for which {to} has no field")
    with _replacing(target) as partial:
        if to == "spikeserve":
            write_cbor(data, partial)
        else:
            partial.mkdir()
            if to == "minari":
                write_minari(data, partial, target.name)
            else:
                {"lerobot": write_lerobot, "mcap": write_mcap}[to](data, partial)
    return data


@contextlib.contextmanager
def _replacing(target: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yields a path beside `target`, and renames it to `target` unless an error is raised."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
        partial = pathlib.Path(folder, target.name)
        yield partial
        old = pathlib.Path(folder, "old")
        if target.exists():
            target.rename(old)
        try:
            partial.rename(target)
        except OSError:
            if old.exists():
                old.rename(target)
            raise
        if old.is_dir():
            shutil.rmtree(old)
