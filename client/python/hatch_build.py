"""Compiles the wire contract and the robot's state machine when pip builds the package.

Without a compiler, Python's headers or nanobind, the package has no pilot, and a warning says why.
"""

import concurrent.futures
import importlib
import importlib.resources
import os
import pathlib
import shlex
import subprocess
import sysconfig
import tempfile

from grpc_tools import protoc
from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PROTOS = [
    "google/rpc/status.proto",
    "google/rpc/error_details.proto",
    "spikeserve/v1/policy_service.proto",
    "spikeserve/v1/policy_admin.proto",
]
DESCRIPTOR = "spikeserve/contract.binpb"
# A cross-built module has the suffix of another machine.
SUFFIX = os.environ.get("SETUPTOOLS_EXT_SUFFIX") or sysconfig.get_config_var("EXT_SUFFIX")
MODULE = f"spikeserve/_robot{SUFFIX}"


class CompiledParts(BuildHookInterface):
    """Compiles PROTOS to DESCRIPTOR and core/robot to MODULE, beside the package's modules."""

    def initialize(self, version, build_data):
        """Writes to the source tree for an editable installation, and to the wheel otherwise."""
        self._output = tempfile.TemporaryDirectory()
        is_editable = version == "editable"
        folder = pathlib.Path(self.root, "src") if is_editable else pathlib.Path(self._output.name)
        (folder / "spikeserve").mkdir(exist_ok=True)
        root = self._sources()
        compile_proto(root / "proto", folder / DESCRIPTOR)
        compiled = [DESCRIPTOR]
        try:
            compile_robot(root, folder / MODULE)
        except (ImportError, OSError, subprocess.CalledProcessError) as error:
            reason = getattr(error, "stderr", None) or error
            self.app.display_warning(
                f"spikeserve.Pilot is left out, because it needs a compiler: {reason}"
            )
        else:
            compiled.append(MODULE)
            build_data["pure_python"], build_data["tag"] = False, platform_tag()
        if not is_editable:
            build_data["force_include"].update({str(folder / name): name for name in compiled})

    def finalize(self, version, build_data, artifact_path):
        """Removes the compiled files. The wheel has copies."""
        self._output.cleanup()

    def _sources(self):
        """Returns the root of the repository, or of a source distribution with parts of it."""
        roots = [pathlib.Path(self.root), pathlib.Path(self.root, "../..").resolve()]
        for root in roots:
            if all((root / "proto" / proto).is_file() for proto in PROTOS):
                return root
        raise FileNotFoundError(f"{PROTOS}: expected in one of {[*map(str, roots)]}, received none")


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


def compile_robot(root, output):
    """Compiles core/robot and client/python/robot, below `root`, to a module for this Python.

    CXX, CXXFLAGS and LDFLAGS of the environment have their usual meaning.
    """
    nanobind = importlib.import_module("nanobind")
    library = pathlib.Path(nanobind.source_dir())
    sources = [
        library / "nb_combined.cpp",
        *sorted(root.glob("core/robot/*.cc")),
        *sorted(root.glob("client/python/robot/*.cc")),
    ]
    systems = [
        sysconfig.get_path("include"),
        nanobind.include_dir(),
        library.parent / "ext/robin_map/include",
    ]
    compiler = shlex.split(os.environ.get("CXX", "c++"))
    flags = ["-std=c++20", "-O2", "-DNDEBUG", "-fPIC", "-fvisibility=hidden", "-Wall", "-Wextra"]
    flags.append("-fno-strict-aliasing")  # as nanobind's own build compiles it
    flags += shlex.split(os.environ.get("CXXFLAGS", ""))
    flags += [f"-I{root}", *(f"-isystem{path}" for path in systems)]

    def run(*arguments):
        subprocess.run(
            [*compiler, *map(str, arguments)], check=True, capture_output=True, text=True
        )

    with (
        tempfile.TemporaryDirectory() as folder,
        concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool,
    ):
        objects = [pathlib.Path(folder, f"{source.stem}.o") for source in sources]
        list(pool.map(lambda source, out: run(*flags, "-c", source, "-o", out), sources, objects))
        run("-shared", "-s", *objects, "-o", output, *shlex.split(os.environ.get("LDFLAGS", "")))


def platform_tag():
    """Returns the tag of a wheel with MODULE: it runs with this CPython on this kind of machine."""
    python = f"cp{sysconfig.get_config_var('py_version_nodot')}"
    platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    return f"{python}-{python}-{platform}"
