"""Compiles the wire contract into the package while it is built or installed."""

import pathlib
import tempfile

from grpc_tools import protoc
from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PROTO = "spikeserve/v1/policy_service.proto"
DESCRIPTOR = "spikeserve/policy_service.binpb"


class WireContract(BuildHookInterface):
    """Puts the compiled PROTO beside the modules as DESCRIPTOR."""

    def initialize(self, version, build_data):
        """Writes into the source tree for an editable installation, into the wheel otherwise."""
        if version == "editable":
            compile_proto(self._proto_root(), pathlib.Path(self.root, "src", DESCRIPTOR))
            return
        self._output = tempfile.TemporaryDirectory()
        compiled = pathlib.Path(self._output.name, "descriptor")
        compile_proto(self._proto_root(), compiled)
        build_data["force_include"][str(compiled)] = DESCRIPTOR

    def finalize(self, version, build_data, artifact_path):
        """Removes what the wheel has taken."""
        if version != "editable":
            self._output.cleanup()

    def _proto_root(self):
        """The repository's proto/, or its copy inside a source distribution."""
        roots = [pathlib.Path(self.root, "proto"), pathlib.Path(self.root, "../../proto")]
        for root in roots:
            if (root / PROTO).is_file():
                return root
        raise FileNotFoundError(f"{PROTO}: expected in one of {[str(root) for root in roots]}")


def compile_proto(root, output):
    """Compiles PROTO, found below `root`, to a FileDescriptorSet."""
    arguments = ["protoc", f"--proto_path={root}", f"--descriptor_set_out={output}", PROTO]
    if protoc.main(arguments) != 0:
        raise RuntimeError(f"protoc failed on {root / PROTO}")
