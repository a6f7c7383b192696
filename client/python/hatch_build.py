"""Compiles the wire contract into the package when pip builds or installs it."""

import importlib.resources
import pathlib
import tempfile

from grpc_tools import protoc
from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PROTOS = ["spikeserve/v1/policy_service.proto", "spikeserve/v1/policy_admin.proto"]
DESCRIPTOR = "spikeserve/contract.binpb"


class WireContract(BuildHookInterface):
    """Compiles PROTOS to DESCRIPTOR, beside the modules of the package."""

    def initialize(self, version, build_data):
        """Writes to the source tree for an editable installation, and to the wheel otherwise."""
        if version == "editable":
            compile_proto(self._proto_root(), pathlib.Path(self.root, "src", DESCRIPTOR))
            return
        self._output = tempfile.TemporaryDirectory()
        compiled = pathlib.Path(self._output.name, "descriptor")
        compile_proto(self._proto_root(), compiled)
        build_data["force_include"][str(compiled)] = DESCRIPTOR

    def finalize(self, version, build_data, artifact_path):
        """Removes the compiled file. The wheel has a copy."""
        if version != "editable":
            self._output.cleanup()

    def _proto_root(self):
        """Returns the proto/ of the repository, or its copy in a source distribution."""
        roots = [pathlib.Path(self.root, "proto"), pathlib.Path(self.root, "../../proto")]
        for root in roots:
            if all((root / proto).is_file() for proto in PROTOS):
                return root
        raise FileNotFoundError(
            f"{PROTOS}: expected in one of {[str(root) for root in roots]}, received none"
        )


def compile_proto(root, output):
    """Compiles PROTOS, paths below `root`, to a FileDescriptorSet in the file `output`.

    The set has the comments of the contract, which become the docstrings of AdminClient.
    """
    # By itself, protoc looks for the protos of protobuf in ../include of the Python program, where
    # only Debian's libprotobuf-dev puts them.
    well_known = importlib.resources.files("grpc_tools") / "_proto"
    arguments = [
        "protoc",
        f"--proto_path={root}",
        f"--proto_path={well_known}",
        f"--descriptor_set_out={output}",
        "--include_source_info",
        *PROTOS,
    ]
    if protoc.main(arguments) != 0:
        raise RuntimeError(f"protoc failed on {PROTOS} of {root}")
