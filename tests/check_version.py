"""Checks that every place that names the version of the project names that of CMakeLists.txt, and that CHANGELOG.md has it.

Programs, packages, wheels and the release's files take it from there. What cannot is listed here; after a change of the
version "--write" changes those places, too.
"""

import pathlib
import re
import sys

ROOT = pathlib.Path(__file__).parents[1]
SOURCE = re.compile(r"project\(spikeserve VERSION ([\d.]+)")
# Where else the version stands: a pattern with one group, MAJOR.MINOR.PATCH or MAJOR.MINOR.
PLACES = {
    "SECURITY.md": [r"^\| ([\d.]+)\.x \| yes \|"],
    "deploy/compose/compose.yaml": [r"image: spikeserve:([\d.]+)"],
    "deploy/helm/spikeserve/Chart.yaml": [r"^version: ([\d.]+)", r"^appVersion: ([\d.]+)"],
    "deploy/image/Dockerfile": [r"-t spikeserve:([\d.]+)"],
    "docs/guides/image.md": [r"spikeserve:([\d.]+)"],
    "docs/guides/packages.md": [r"dist/spikeserve(?:_engine)?-([\d.]+)-"],
    "client/rust/Cargo.toml": [r'^version = "([\d.]+)"'],
    "docs/start/c.md": [r"spikeserve-robot-(?:rust|go)-([\d.]+)", r"robot@v([\d.]+)"],
    "docs/start/cpp.md": [r"find_package\(spikeserve ([\d.]+)"],
    "ros/spikeserve_ros/package.xml": [r"<version>([\d.]+)<"],
    "ros/spikeserve_ros/setup.py": [r'version="([\d.]+)"'],
    "tests/install/consumer/CMakeLists.txt": [r"find_package\(spikeserve ([\d.]+)"],
    **{
        path.relative_to(ROOT).as_posix(): [
            r"app\.kubernetes\.io/version: ([\d.]+)",
            r"helm\.sh/chart: spikeserve-([\d.]+)",
            r"image: spikeserve:([\d.]+)",
        ]
        for path in sorted((ROOT / "tests/kubernetes/rendered").glob("*.yaml"))
    },
}


def main():
    version = SOURCE.search((ROOT / "CMakeLists.txt").read_text())[1]
    complaints, count = [], 0
    if f"\n## [{version}]" not in (ROOT / "CHANGELOG.md").read_text():
        complaints.append(f"CHANGELOG.md: expected a section [{version}], received none")
    for name, patterns in PLACES.items():
        text = (ROOT / name).read_text()
        for pattern in patterns:
            found = list(re.finditer(pattern, text, re.MULTILINE))
            count += len(found)
            if not found:
                complaints.append(f"{name}: expected {pattern}, received no such text")
            for match in reversed(found):
                expected = version.rpartition(".")[0] if match[1].count(".") == 1 else version
                if match[1] != expected:
                    complaints.append(f"{name}: expected {expected}, received {match[0]}")
                    text = text[: match.start(1)] + expected + text[match.end(1) :]
        if "--write" in sys.argv[1:]:
            (ROOT / name).write_text(text)
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    print(f"check_version: {version}, {count} places, {len(complaints)} complaints")
    sys.exit(1 if complaints else 0)


if __name__ == "__main__":
    main()
