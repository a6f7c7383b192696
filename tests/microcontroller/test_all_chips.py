"""All shipped policies on all emulated microcontrollers, 100,000 decisions each: a day of one processor.

CHIP_DECISIONS sets another number.
"""

import os

import pytest
from emitted import emit, name_of, play, shipped
from emulated import CHIPS

DECISIONS = int(os.environ.get("CHIP_DECISIONS", "100000"))


@pytest.fixture(scope="module", params=shipped(), ids=name_of)
def emitted(request, tmp_path_factory):
    return emit(request.param, tmp_path_factory.mktemp("policy"), DECISIONS)


def test_this_machine(emitted):
    assert play(emitted, emitted.compile(["gcc"], "-O2")) == emitted.hash


@pytest.mark.parametrize("level", ["-Os", "-O3"])
@pytest.mark.parametrize("chip", CHIPS)
def test_chip(chip, level, emitted):
    assert CHIPS[chip].run(emitted, level)[0] == emitted.hash
