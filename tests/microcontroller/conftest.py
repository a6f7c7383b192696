"""Makes the helpers of the tests in Python importable."""

import pathlib
import sys

sys.path[:0] = [str(pathlib.Path(__file__).parents[1] / "python" / folder) for folder in ("", "train")]
