#!/usr/bin/env python3
"""Prints the libraries of Debian that a program links and the CVEs that each one's package has fixed, as a Markdown table.

The fixed CVEs are those that the changelog of the installed package names. With a copy of the data of Debian's security
tracker (https://security-tracker.debian.org/tracker/data/json), the table has the open ones, too.

    deploy/library_cves.py build/release/bin/spikeserve [--tracker=FILE]
"""

import argparse
import gzip
import json
import pathlib
import re
import subprocess

CVE = re.compile(r"CVE-\d{4}-\d+")
RELEASE = "bookworm"


def output(*command):
    return subprocess.run(command, check=False, capture_output=True, text=True).stdout


def linked_libraries(program):
    """Returns the paths of the shared libraries that the program loads."""
    return re.findall(r"=> (/\S+)", output("ldd", program))


def packages_of(libraries):
    """Returns the installed packages that contain libraries, sorted."""
    paths = {str(pathlib.Path(library).resolve()) for library in libraries}
    # Packages of Debian 12 may name /lib for what lies in /usr/lib.
    paths |= {path.removeprefix("/usr") for path in paths}
    owners = output("dpkg-query", "--search", *paths)
    return sorted({owner.split(":")[0] for owner in owners.splitlines()})


def description(package):
    """Returns the source package and the version."""
    fields = output("dpkg-query", "--show", "--showformat=${source:Package} ${Version}", package)
    source, version = fields.split()
    return source, version


def cve_order(cve):
    return [int(part) for part in cve.split("-")[1:]]


def fixed_cves(package):
    """Returns the CVEs that the changelog of a package names."""
    changelog = pathlib.Path(f"/usr/share/doc/{package}/changelog.Debian.gz")
    text = gzip.decompress(changelog.read_bytes()).decode(errors="replace") if changelog.exists() else ""
    return sorted(set(CVE.findall(text)), key=cve_order)


def open_cves(tracker, source):
    """Returns the CVEs of a source package that Debian's release has not fixed, with the tracker's urgency."""
    found = []
    for cve, entry in tracker.get(source, {}).items():
        state = entry.get("releases", {}).get(RELEASE, {})
        if state.get("status") == "open":
            found.append(f"{cve} ({state.get('urgency', 'unknown')})")
    return sorted(found)


def shortened(cves, count=6):
    """Returns the newest CVEs as text, and how many more there are."""
    text = ", ".join(cves[-count:]) or "none"
    return text if len(cves) <= count else f"{text} and {len(cves) - count} older ones"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("program", help="a program")
    parser.add_argument("--tracker", type=pathlib.Path, help="data of Debian's security tracker")
    arguments = parser.parse_args()
    tracker = json.loads(arguments.tracker.read_text()) if arguments.tracker else None
    columns = ["package", "version", "fixed by Debian"] + (["open"] if tracker is not None else [])
    print(f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}")
    for package in packages_of(linked_libraries(arguments.program)):
        source, version = description(package)
        row = [package, version, shortened(fixed_cves(package))]
        if tracker is not None:
            row.append(", ".join(open_cves(tracker, source)) or "none")
        print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    main()
