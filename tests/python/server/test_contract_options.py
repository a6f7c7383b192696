"""Generators of other languages take the contract as it is, without a flag for each of its files."""

import pathlib
import re
import subprocess
import sys

import pytest
from google.protobuf import descriptor_pb2

PROTO = pathlib.Path(__file__).parents[3] / "proto"
FILES = ("spikeserve/v1/policy_service.proto", "spikeserve/v1/policy_admin.proto")


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    path = tmp_path_factory.mktemp("descriptors") / "contract"
    command = [sys.executable, "-m", "grpc_tools.protoc", f"--proto_path={PROTO}", f"--descriptor_set_out={path}"]
    subprocess.run([*command, *FILES], check=True)
    return [file.options for file in descriptor_pb2.FileDescriptorSet.FromString(path.read_bytes()).file]


def test_go_has_a_path(options):
    """protoc-gen-go refuses a file without one, and a path without a slash or a dot."""
    (package,) = {each.go_package for each in options}
    assert re.fullmatch(r"[a-z0-9]+(/[a-z0-9]+)+;[a-z0-9]+", package)


def test_java_and_csharp_keep_the_names_that_they_chose(options):
    assert {(each.java_package, each.csharp_namespace) for each in options} == {("spikeserve.v1", "Spikeserve.V1")}
