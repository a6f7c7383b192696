#!/usr/bin/env python3
"""Prints the notes of a release, cut from the changelog: notes.py CHANGELOG VERSION

These are the changes that are not released yet, if there are any, and those of VERSION otherwise.
"""

import pathlib
import re
import sys


def section(changelog, title):
    """Returns the text below the heading of a version, without the heading."""
    found = re.search(rf"^## \[{re.escape(title)}\][^\n]*\n(.*?)(?=^## |\Z)", changelog, re.MULTILINE | re.DOTALL)
    if found is None:
        sys.exit(f"changelog: expected a section {title}, received none")
    return found[1].strip()


def main():
    changelog, version = pathlib.Path(sys.argv[1]).read_text(), sys.argv[2]
    unreleased = section(changelog, "Unreleased")
    title = f"spikeserve after {version}" if unreleased else f"spikeserve {version}"
    print(f"# {title}\n\n{unreleased or section(changelog, version)}")


if __name__ == "__main__":
    main()
