"""All shipped policies on all emulated processors, 100,000 decisions each: a day of one processor.

CHIP_DECISIONS sets another number.
"""

import os

import pytest
from emitted import emit, name_of, play, shipped
from emulated import CHIPS, HOSTS

DECISIONS = int(os.environ.get("CHIP_DECISIONS", "100000"))


@pytest.fixture(scope="module", params=shipped(), ids=name_of)
def emitted(request, tmp_path_factory):
    return emit(request.param, tmp_path_factory.mktemp("policy"), DECISIONS)


@pytest.mark.parametrize("host", HOSTS)
def test_host(host, emitted):
    compiler, emulator = HOSTS[host]
    assert play(emitted, emitted.compile(compiler), emulator) == emitted.hash


@pytest.mark.parametrize("level", ["-Os", "-O3"])
@pytest.mark.parametrize("chip", CHIPS)
def test_chip(chip, level, emitted):
    assert CHIPS[chip].run(emitted, level, counts=False)[0] == emitted.hash
