"""Three policies on emulated microcontrollers and other processors decide as the server does, bit for bit."""

from dataclasses import replace

import pytest
from emitted import emit, name_of, play, shipped
from emulated import CHIPS, HOSTS, MICROBIT

FILES = {name_of(file): file for file in shipped()}
NAMES = ("cartpole-small-1", "pendulum-delay-1", "lunar-lander-1")


@pytest.fixture(scope="module", params=NAMES)
def emitted(request, tmp_path_factory):
    return emit(FILES[request.param], tmp_path_factory.mktemp(request.param), decisions=120)


@pytest.mark.parametrize("level", ["-Os", "-O3"])
@pytest.mark.parametrize("chip", ["cortex-m0plus", "cortex-m4", "rv32imc"])
def test_equal_hashes(chip, level, emitted):
    assert CHIPS[chip].run(emitted, level)[0] == emitted.hash


@pytest.mark.parametrize("host", HOSTS)
def test_equal_hashes_on_hosts(host, emitted):
    compiler, emulator = HOSTS[host]
    assert play(emitted, emitted.compile(compiler), emulator) == emitted.hash


@pytest.mark.parametrize("file", shipped(), ids=name_of)
def test_every_policy_fits_a_large_chip(file, tmp_path):
    """A Cortex-M7 of 512 KB of flash and 256 KB of RAM, with all seven functions and 16 KB of stack."""
    chip = replace(CHIPS["cortex-m7"], memory=(0, 512 << 10, 0x20000000, (256 - 16) << 10))
    chip.link(emit(file, tmp_path, decisions=1), "-Os", program="calls_all.c")


def test_memory_of_the_smallest(tmp_path):
    """At most 20 KB of flash on a Cortex-M4, and 8 KB of RAM, with all seven functions."""
    emitted = emit(FILES["cartpole-small-1"], tmp_path, decisions=120)
    answers = MICROBIT.run(emitted, "-Os")
    assert answers[0] == emitted.hash
    assert emitted.sizes["state_bytes"] + int(answers[3], 16) < 8 << 10
    assert CHIPS["cortex-m4"].flash(emitted) <= 20 << 10
