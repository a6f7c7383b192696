"""Which MCAP files of a folder are one log: those into which rosbag2 has split a recording."""

from __future__ import annotations

import pathlib
import re

from spikeserve.check import check
from spikeserve.conversion import mcap_layout as layout

_METADATA = "metadata.yaml"
_INFORMATION = "rosbag2_bagfile_information"
_FILES = re.compile(r"^ *relative_file_paths: *\n((?: *- .*(?:\n|$))+)", re.MULTILINE)


def logs_of(source: pathlib.Path) -> tuple[list[list[pathlib.Path]], list[str]]:
    """Returns the files of each log below `source`, and notes.

    Files that one metadata.yaml of rosbag2 lists are one log, in its order. Every other file is a
    log, in the order of the numbers in its name.
    """
    if source.is_file():
        files = _files_of_bag(source.parent) or [source]
        part = f"{source}: one of {len(files)} files of a recording; {source.parent} is all of it"
        return [[source]], [part] if len(files) > 1 and source in files else []
    logs, notes = [], []
    by_folder: dict[pathlib.Path, list[pathlib.Path]] = {}
    for path in sorted(source.rglob(f"*{layout.SUFFIX}"), key=_by_numbers):
        by_folder.setdefault(path.parent, []).append(path)
    for folder, found in by_folder.items():
        bag = _files_of_bag(folder)
        if bag is None:
            logs += [[path] for path in found]
            parts = [p for p in found if re.fullmatch(re.escape(folder.name) + r"_\d+", p.stem)]
            if len(parts) > 1:
                notes.append(
                    f"{folder}: an episode for each of {len(parts)} files; if they are parts of "
                    f"one recording, `ros2 bag reindex` writes the {_METADATA} that says so"
                )
            continue
        for path in bag:
            check(path in found, str(folder / _METADATA), f"the file {path.name}", "none")
        for path in found:
            check(path in bag, str(path), f"a file that {folder / _METADATA} lists", "another")
        logs.append(bag)
    return logs, notes


def _by_numbers(path: pathlib.Path) -> list[tuple[str, int]]:
    """Returns a key that sorts drive_2 before drive_10."""
    return [(text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", str(path))]


def _files_of_bag(folder: pathlib.Path) -> list[pathlib.Path] | None:
    """Returns the files that the metadata.yaml of rosbag2 lists; None: there is no such file."""
    metadata = folder / _METADATA
    if not metadata.is_file():
        return None
    text = metadata.read_text("utf-8", errors="replace")
    if _INFORMATION not in text:
        return None
    listed = _FILES.search(text)
    expected = "relative_file_paths, a list of files"
    check(listed is not None, str(metadata), expected, "none")
    assert listed is not None
    names = [line.strip()[2:].strip(" \"'") for line in listed[1].splitlines()]
    for name in names:
        uncompressed = name.endswith(layout.SUFFIX)
        expected = f"files *{layout.SUFFIX}; `ros2 bag convert` writes them"
        check(uncompressed, f"{metadata}: relative_file_paths", expected, name)
    return [folder / pathlib.PurePath(name).name for name in names]
