"""-DSPIKESERVE_TORCH=DIR links the libtorch of a PyTorch wheel. Uses a stand-in for the wheel, which has 900 MB.

The stand-in has the layout of a wheel. A program that is built with it and runs shows that headers and libraries are
those of the folder.
"""

import pathlib
import subprocess

import pytest
from serving import run

ROOT = pathlib.Path(__file__).parents[3]
PROJECT = f"""
cmake_minimum_required(VERSION 3.25)
project(stand_in LANGUAGES CXX)
include({ROOT}/cmake/TorchWheel.cmake)
add_executable(program program.cc)
target_link_libraries(program PRIVATE torch)
install(TARGETS program)
"""
PROGRAM = """
#include <c10/version.h>
#include <torch/types.h>
int main() { return torch_cpu() + c10() == 5 ? 0 : 1; }
"""


def make_wheel(folder, version):
    """Writes a folder with the layout of the wheel's folder torch."""
    headers = {"torch/csrc/api/include/torch/types.h": "int torch_cpu();\n", "c10/version.h": "int c10();\n"}
    for path, text in headers.items():
        header = folder / "include" / path
        header.parent.mkdir(parents=True)
        header.write_text(text)
    (folder / "lib").mkdir()
    for name, value in (("torch_cpu", 2), ("c10", 3)):
        source = folder / f"{name}.cc"
        source.write_text(f"int {name}() {{ return {value}; }}\n")
        library = folder / "lib" / f"lib{name}.so"
        subprocess.run(["g++", "-shared", "-fPIC", str(source), "-o", str(library)], check=True)
    (folder / "version.py").write_text(f"__all__ = ['__version__']\n__version__ = '{version}'\ncuda = '12.8'\n")


def configure(tmp_path, torch, status=0):
    source = tmp_path / "source"
    source.mkdir()
    (source / "CMakeLists.txt").write_text(PROJECT)
    (source / "program.cc").write_text(PROGRAM)
    return run("cmake", "-S", source, "-B", tmp_path / "build", f"-DSPIKESERVE_TORCH={torch}", status=status)


def test_a_program_links_the_libraries_of_the_wheel(tmp_path):
    wheel = tmp_path / "site-packages/torch"
    make_wheel(wheel, "2.10.0+cu128")
    configured = configure(tmp_path, wheel)
    assert f"Training links PyTorch 2.10.0 of {wheel}" in configured.stdout
    run("cmake", "--build", tmp_path / "build")
    run(tmp_path / "build/program")
    run("cmake", "--install", tmp_path / "build", "--prefix", tmp_path / "installed")
    run(tmp_path / "installed/bin/program")  # which finds the libraries


@pytest.mark.parametrize("version", ["2.6.0+cu124", "1.13.1"])
def test_wheels_with_another_abi_are_refused(tmp_path, version):
    make_wheel(tmp_path / "torch", version)
    refused = configure(tmp_path, tmp_path / "torch", status=1)
    expected = f"SPIKESERVE_TORCH: expected PyTorch 2.7 or later, received {version.partition('+')[0]}"
    assert expected in " ".join(refused.stderr.split())


def test_other_folders_are_refused(tmp_path):
    refused = configure(tmp_path, tmp_path, status=1)
    assert "SPIKESERVE_TORCH: expected the folder torch of a PyTorch wheel" in " ".join(refused.stderr.split())
