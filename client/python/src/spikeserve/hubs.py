"""Brings policy files from and to hubs, with the libraries of these: the command `hubs`.

    python -m spikeserve.hubs pull hf://OWNER/REPOSITORY[@REVISION]/PATH new.safetensors
    python -m spikeserve.hubs push new.safetensors s3://BUCKET/KEY
    python -m spikeserve.hubs push new.safetensors oci://HOST/NAME:TAG

Next is `spikectl push`: a server loads nothing from a hub. The signature `FILE.sig` goes along if
there is one. Credentials and endpoints are those of the libraries: huggingface_hub (HF_TOKEN,
HF_ENDPOINT), boto3 (AWS_*) and oras (`~/.docker/config.json`), of which each scheme needs one.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import re
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from spikeserve.check import check
from spikeserve.printing import say

POLICY = "policy.safetensors"
SIGNATURE = POLICY + ".sig"


def _library(name: str, extra: str) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise ValueError(f"{name}: expected the library, as in spikeserve[{extra}]") from error


class HuggingFace:
    """hf://OWNER/REPOSITORY[@REVISION]/PATH. Both files change in one commit.

    The files of each class are POLICY and, if there is one, SIGNATURE. Methods may raise any error
    of the library.
    """

    def __init__(self, place: str, plain_http: bool) -> None:
        match = re.fullmatch(r"([^/@]+/[^/@]+)(?:@([^/]+))?/(.+)", place)
        check(match is not None, "place", "hf://OWNER/REPOSITORY[@REVISION]/PATH", f"hf://{place}")
        assert match is not None
        self._repo, self._revision, self._path = match.groups()
        self._library = _library("huggingface_hub", "hf")

    def pull(self, folder: Path) -> None:
        """Writes the files of the place into `folder`."""
        api = self._library.HfApi()
        revision = api.repo_info(self._repo, revision=self._revision).sha  # one for both files
        for name, path in ((POLICY, self._path), (SIGNATURE, f"{self._path}.sig")):
            with tempfile.TemporaryDirectory() as cache:
                options = {"revision": revision, "cache_dir": cache}
                try:
                    found = api.hf_hub_download(self._repo, path, **options)
                except self._library.errors.EntryNotFoundError:
                    if name == POLICY:
                        raise
                    return
                (folder / name).write_bytes(Path(found).read_bytes())

    def push(self, files: dict[str, Path]) -> None:
        """Writes the files to the place."""
        operations = [
            self._library.CommitOperationAdd(
                path_in_repo=self._path + name.removeprefix(POLICY), path_or_fileobj=file
            )
            for name, file in files.items()
        ]
        api, signature = self._library.HfApi(), f"{self._path}.sig"
        where = {"revision": self._revision}
        # That of the policy before, which the hub must not show beside this one.
        if SIGNATURE not in files and api.file_exists(self._repo, signature, **where):
            operations.append(self._library.CommitOperationDelete(path_in_repo=signature))
        api.create_commit(self._repo, operations, commit_message=f"Add {self._path}", **where)


class S3:
    """s3://BUCKET/KEY. The signature is written first: a reader of the policy finds it."""

    def __init__(self, place: str, plain_http: bool) -> None:
        self._bucket, _, self._key = place.partition("/")
        check(bool(self._bucket and self._key), "place", "s3://BUCKET/KEY", f"s3://{place}")
        self._client = _library("boto3", "s3").client("s3")

    def pull(self, folder: Path) -> None:
        """Writes the files of the place into `folder`."""
        self._client.download_file(self._bucket, self._key, str(folder / POLICY))
        try:
            self._client.download_file(self._bucket, f"{self._key}.sig", str(folder / SIGNATURE))
        except self._client.exceptions.ClientError as error:
            if error.response["Error"]["Code"] not in ("404", "NoSuchKey"):
                raise

    def push(self, files: dict[str, Path]) -> None:
        """Writes the files to the place."""
        for name, file in reversed(files.items()):
            key = self._key + name.removeprefix(POLICY)
            self._client.upload_file(str(file), self._bucket, key)
        if SIGNATURE not in files:  # that of the policy before, if there is one
            self._client.delete_object(Bucket=self._bucket, Key=f"{self._key}.sig")


class Registry:
    """oci://HOST/NAME:TAG or @DIGEST: an artifact whose layers are the files."""

    def __init__(self, place: str, plain_http: bool) -> None:
        check("/" in place, "place", "oci://HOST/NAME:TAG", f"oci://{place}")
        self._target = place
        self._client = _library("oras.client", "oci").OrasClient(insecure=plain_http)

    def pull(self, folder: Path) -> None:
        """Writes the files of the place into `folder`."""
        container = self._client.get_container(self._target)
        self._client.auth.load_configs(container)
        layers = self._client.get_manifest(container)["layers"]
        title = "org.opencontainers.image.title"
        digests = {(each.get("annotations") or {}).get(title): each["digest"] for each in layers}
        check(POLICY in digests, "layers", f"one named {POLICY}", sorted(map(str, digests)))
        for name in (POLICY, SIGNATURE):
            if name in digests:
                self._client.download_blob(container, digests[name], str(folder / name))
                received = f"sha256:{hashlib.sha256((folder / name).read_bytes()).hexdigest()}"
                check(received == digests[name], name, digests[name], received)

    def push(self, files: dict[str, Path]) -> None:
        """Writes the files to the place."""
        with tempfile.TemporaryDirectory() as folder:
            for name, file in files.items():  # names of layers are those of files
                (Path(folder) / name).write_bytes(file.read_bytes())
            paths = [f"{folder}/{name}" for name in files]
            options = {"disable_path_validation": True, "quiet": True}
            self._client.push(self._target, files=paths, **options)


HUBS: dict[str, Any] = {"hf": HuggingFace, "s3": S3, "oci": Registry}


def hub_of(place: str, plain_http: bool = False) -> Any:
    """Returns what `place` names. ValueError if it names none, or if its library is missing."""
    scheme, separator, rest = place.partition("://")
    check(bool(separator) and scheme in HUBS, "place", "hf://, oci:// or s3://", place)
    return HUBS[scheme](rest, plain_http)


def pull(hub: Any, file: Path) -> str:
    """Writes the policy to `file`, with its signature beside it, and returns its SHA-256."""
    signature = file.with_name(f"{file.name}.sig")
    with tempfile.TemporaryDirectory(dir=file.parent) as name:
        folder = Path(name)
        hub.pull(folder)
        digest = hashlib.sha256((folder / POLICY).read_bytes()).hexdigest()
        signature.unlink(missing_ok=True)  # of another file
        (folder / POLICY).replace(file)
        if (folder / SIGNATURE).exists():
            (folder / SIGNATURE).replace(signature)
    return digest


def push(hub: Any, file: Path) -> str:
    """Writes `file` to the hub, with the signature beside it, and returns its SHA-256."""
    files = {POLICY: file, SIGNATURE: file.with_name(f"{file.name}.sig")}
    hub.push({name: path for name, path in files.items() if name == POLICY or path.exists()})
    return hashlib.sha256(file.read_bytes()).hexdigest()


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command and returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m spikeserve.hubs",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--plain_http", action="store_true", help="oci: a registry without TLS")
    commands = parser.add_subparsers(dest="command", required=True, metavar="pull|push")
    for name, places in (("pull", ("place", "file")), ("push", ("file", "place"))):
        command = commands.add_parser(name)
        for place in places:
            command.add_argument(place)
    options = parser.parse_args(arguments)
    run = pull if options.command == "pull" else push
    try:
        digest = run(hub_of(options.place, options.plain_http), Path(options.file))
    except Exception as error:  # the libraries raise many kinds
        say(f"hubs: {options.place}: {error}", error=True)
        return 1
    say(f"{options.file} {digest}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
