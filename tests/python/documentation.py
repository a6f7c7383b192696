"""Runs the examples of a documentation page as a reader would."""

import pathlib
import re

DOCS = pathlib.Path(__file__).parents[2] / "docs"
PAGES_SERVER = "127.0.0.1:50051"


def run_examples(page, address):
    """Runs every Python example of docs/<page>, in order, against the server at `address`."""
    path = DOCS / page
    examples = re.findall(r"^```python\n(.*?)^```$", path.read_text(), re.MULTILINE | re.DOTALL)
    assert examples
    names = {}
    for example in examples:
        exec(compile(example.replace(PAGES_SERVER, address), path, "exec"), names)
