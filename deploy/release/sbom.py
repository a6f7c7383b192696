#!/usr/bin/env python3
"""Prints an SBOM (SPDX 2.3, JSON) of a folder with a release: sbom.py DIST_DIR VERSION BIN_DIR

Names each published file with its SHA-256, the packages of Debian that the programs in BIN_DIR load or are compiled with,
the files of others in the source tree, and what the Python packages require. SOURCE_DATE_EPOCH is its time.
"""

import datetime
import email
import hashlib
import json
import os
import pathlib
import re
import subprocess
import sys
import zipfile

ROOT = pathlib.Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "deploy"))
from library_cves import linked_libraries, output, packages_of  # noqa: E402

# Packages whose code is compiled or linked into the programs.
BOOST = output("dpkg-query", "--show", "--showformat=${Depends}", "libboost-dev")  # that of the release of Debian
COMPILED_IN = (
    f"libgrpc++-dev libgrpc-dev libhwy-dev nlohmann-json3-dev libcli11-dev libeigen3-dev {BOOST or 'libboost-dev'} libspdlog-dev"
).split()
PROGRAMS = {
    "spikeserve": "spikeserve",
    "spikeserve-tools": "spikectl",
    "spikeserve-train": "spiketrain",
    "libspikeserve-robot0": "../lib/libspikeserve_robot.so",
}


def identifier(*parts):
    return "SPDXRef-" + re.sub(r"[^A-Za-z0-9.-]", "-", "-".join(parts))


class Document:
    """An SPDX document that grows by packages and relationships."""

    def __init__(self, name, commit, created):
        self.json = {
            "spdxVersion": "SPDX-2.3",
            "dataLicense": "CC0-1.0",
            "SPDXID": "SPDXRef-DOCUMENT",
            "name": name,
            "documentNamespace": f"https://spikeserve.invalid/spdx/{name}-{commit}",
            "creationInfo": {"created": created, "creators": ["Organization: spikeserve", "Tool: sbom.py"]},
            "packages": [],
            "relationships": [],
        }

    def add(self, ref, name, version, license_name="NOASSERTION", **more):
        if all(package["SPDXID"] != ref for package in self.json["packages"]):
            package = {
                "SPDXID": ref,
                "name": name,
                "versionInfo": version,
                "downloadLocation": "NOASSERTION",
                "filesAnalyzed": False,
                "licenseConcluded": "NOASSERTION",
                "licenseDeclared": license_name,
                "copyrightText": "NOASSERTION",
            }
            self.json["packages"].append(package | more)
        return ref

    def relate(self, source, kind, target):
        relation = {"spdxElementId": source, "relationshipType": kind, "relatedSpdxElement": target}
        if relation not in self.json["relationships"]:
            self.json["relationships"].append(relation)

    def add_package_of_debian(self, name):
        shown = output("dpkg-query", "--show", "--showformat=${Version} ${Architecture}", name).split()
        if not shown:
            sys.exit(f"sbom: {name}: expected an installed package, received none")
        purl = f"pkg:deb/debian/{name}@{shown[0]}?arch={shown[1]}"
        return self.add(identifier("debian", name), name, shown[0], externalRefs=[reference(purl)])


def reference(purl):
    return {"referenceCategory": "PACKAGE-MANAGER", "referenceType": "purl", "referenceLocator": purl}


def requirements(wheel):
    """Returns the names of the packages that a wheel requires without extras."""
    with zipfile.ZipFile(wheel) as archive:
        [metadata] = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        headers = email.message_from_bytes(archive.read(metadata))
    required = [text for text in headers.get_all("Requires-Dist", []) if "extra ==" not in text]
    return sorted(re.match(r"[A-Za-z0-9._-]+", text)[0].lower() for text in required)


def add_file(document, path, version):
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    ref = document.add(
        identifier("file", path.name),
        path.name,
        version,
        "Apache-2.0",
        packageFileName=path.name,
        checksums=[{"algorithm": "SHA256", "checksumValue": digest}],
    )
    document.relate("SPDXRef-DOCUMENT", "DESCRIBES", ref)
    return ref


def main():
    dist, version, programs = pathlib.Path(sys.argv[1]), sys.argv[2], pathlib.Path(sys.argv[3])
    commit = subprocess.run(["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
    time = datetime.datetime.fromtimestamp(int(os.environ["SOURCE_DATE_EPOCH"]), datetime.timezone.utc)
    document = Document(f"spikeserve-{version}", commit, time.strftime("%Y-%m-%dT%H:%M:%SZ"))
    uplot = document.add(
        identifier("vendored", "uplot"), "uPlot", "1.6.32", "MIT", externalRefs=[reference("pkg:npm/uplot@1.6.32")]
    )
    for path in sorted(dist.iterdir()):
        ref = add_file(document, path, version)
        if path.suffix == ".deb" and (program := PROGRAMS.get(path.name.split("_")[0])):
            for package in packages_of(linked_libraries(programs / program)):
                document.relate(ref, "DYNAMIC_LINK", document.add_package_of_debian(package))
            for package in COMPILED_IN:
                document.relate(ref, "STATIC_LINK", document.add_package_of_debian(package))
            if program == "spikeserve":
                document.relate(ref, "CONTAINS", uplot)
        if path.suffix == ".whl":
            for name in requirements(path):
                required = identifier("pypi", name)
                purl = reference(f"pkg:pypi/{name}")
                document.add(required, name, "NOASSERTION", externalRefs=[purl])
                document.relate(ref, "DEPENDS_ON", required)
    print(json.dumps(document.json, indent=1))


if __name__ == "__main__":
    main()
