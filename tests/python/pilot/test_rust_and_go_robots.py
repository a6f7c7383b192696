"""Robots in Rust and Go, with the crate and the module of client/rust and client/go."""

import os
import shutil

import pytest
from robot_programs import ROOT, SOURCES, installed
from serving import run
from test_c_robot import (  # noqa: F401
    client,
    fly,
    test_a_cable_that_is_pulled_costs_nothing,
    test_a_robot_that_is_held_can_say_so,
    test_each_beat_says_who_chose_its_action,
    test_errors_name_the_field_and_have_a_code,
    test_numbers_are_no_index_of_a_discrete_space,
    test_steps_go_as_datagrams,
    test_the_engine_on_the_robot_and_the_robots_own_function,
    test_times_without_an_end_have_none,
    test_what_a_safety_layer_executes_is_what_the_server_remembers,
)

MANIFEST = """[package]
name = "fly"
version = "0.0.0"
edition = "2021"
[dependencies]
spikeserve-robot = {{ path = "{}" }}
[[bin]]
name = "fly"
path = "fly.rs"
"""


def with_sources(folder):
    for source in SOURCES.iterdir():
        shutil.copy(source, folder)
    return folder


def build_rust(folder):
    (folder / "Cargo.toml").write_text(MANIFEST.format(ROOT / "client/rust"))
    run("cargo", "build", "--offline", "--quiet", cwd=folder, env=installed()[1] | {"CARGO_TARGET_DIR": str(folder)})
    return folder / "debug/fly"


def build_go(folder):
    (folder / "go.mod").write_text(
        "module fly\ngo 1.19\nrequire spikeserve.invalid/robot v0.0.0\n"
        f"replace spikeserve.invalid/robot => {ROOT / 'client/go'}\n"
    )
    run("go", "build", "-o", folder / "fly", "fly.go", cwd=folder, env=installed()[1] | {"GOTOOLCHAIN": "local"})
    return folder / "fly"


@pytest.fixture(scope="module", params=[("cargo", build_rust), ("go", build_go)], ids=["rust", "go"])
def program(request, tmp_path_factory):
    compiler, build = request.param
    if not shutil.which(compiler):
        assert not os.environ.get("CI"), f"{compiler}: expected what `deploy/setup.sh` installs, found none"
        pytest.skip(f"{compiler} is not installed")
    return build(with_sources(tmp_path_factory.mktemp("program")))
