"""What the programs of this package print."""

from __future__ import annotations

import sys


def printable(text: str) -> str:
    r"""Returns a text of a file or a server as one that a terminal shows and does not obey.

    Escapes what is not printable, such as ESC and CR, as \u001b. Line feeds and tabs stay.
    """
    return "".join(c if c.isprintable() or c in "\n\t" else f"\\u{ord(c):04x}" for c in text)


def say(text: object, *, error: bool = False) -> None:
    """Prints a printable() line, to stderr if it is an error."""
    print(printable(str(text)), file=sys.stderr if error else sys.stdout, flush=True)
