"""Progress bars on standard error."""

from __future__ import annotations

from typing import Any

import tqdm


def progress_bar(total: int, unit: str, title: str) -> Any:
    """Returns a bar that is a context manager and has `update(n)`."""
    return tqdm.tqdm(total=total, unit=f" {unit}", desc=title, mininterval=1.0, dynamic_ncols=True)
