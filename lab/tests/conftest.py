"""Makes the modules of the laboratory and the helpers of the product's tests importable."""

import pathlib
import re
import sys

import pytest

LAB = pathlib.Path(__file__).parents[1]
ROOT = LAB.parent
sys.path[:0] = [str(LAB / folder) for folder in ("study", "report", "recipes", "bench", "frontier")] + [
    str(ROOT / "tests" / folder) for folder in ("python", "python/train", "microcontroller")
]


@pytest.fixture(scope="module")
def defined():
    """Returns the names of all tests, their suites and files, and of all attacks."""
    names = set()
    for path in [*ROOT.joinpath("tests").rglob("*"), *LAB.joinpath("tests").rglob("*")]:
        if path.suffix == ".py":
            names.update(re.findall(r"^def (\w+)\(", path.read_text(), re.MULTILINE))
        elif path.suffix == ".cc":
            names.add(path.stem)
            for suite, name in re.findall(r"^TEST(?:_F|_P)?\((\w+),\s*(\w+)\)", path.read_text(), re.MULTILINE):
                names.update((suite, name))
    return names
