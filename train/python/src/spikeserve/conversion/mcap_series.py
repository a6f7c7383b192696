"""The numbers of one topic of a log in the order of time, matched by their names."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.conversion.messages import Numbers


@dataclass
class Series:
    """The messages of one topic: times in nanoseconds, and the numbers of a field."""

    messages: list[tuple[int, Numbers, str]] = field(default_factory=list)  # time, numbers, where

    def add(self, time: int, numbers: Numbers, where: str) -> None:
        """Adds a message. ValueError if an earlier one had other numbers, or names unlike this."""
        if self.messages:
            first = self.messages[0][1]
            named = numbers.names is not None
            expected = "names of its numbers" if first.names is not None else "no names of numbers"
            check(
                named == (first.names is not None),
                where,
                f"{expected}, as in the first message",
                list(numbers.names or ()) or "none",
            )
            size = first.values.size
            expected = f"{size} numbers, as in the first message"
            check(named or numbers.values.size == size, where, expected, numbers.values.size)
        self.messages.append((time, numbers, where))

    def table(self, default_names: tuple[str, ...] = ()) -> Table:
        """Returns the rows. Where numbers have names, a row holds the last number of each name.

        So several publishers may share a topic, and each may order its numbers as it likes.
        Messages before every name has occurred belong to no row. `default_names` are those of
        messages without names.
        """
        messages = sorted(self.messages, key=lambda message: message[0])
        times = [time for time, _, _ in messages]
        integers = all(np.issubdtype(n.values.dtype, np.integer) for _, n, _ in messages)
        if messages[0][1].names is None:
            rows = np.stack([numbers.values.astype(np.float64) for _, numbers, _ in messages])
            usable = len(set(default_names)) == len(default_names) == rows.shape[1]
            return Table(times, rows, integers, default_names if usable else ())
        names = tuple(dict.fromkeys(name for _, n, _ in messages for name in n.names or ()))
        columns = {name: index for index, name in enumerate(names)}
        row = np.full(len(names), np.nan)
        known = np.zeros(len(names), bool)
        rows_of_names, times_of_rows = [], []
        for time, numbers, _ in messages:
            at = [columns[name] for name in numbers.names or ()]
            row[at], known[at] = numbers.values, True
            if known.all():
                rows_of_names.append(row.copy())
                times_of_rows.append(time)
        left_out = len(times) - len(times_of_rows)
        return Table(times_of_rows, np.array(rows_of_names), integers, names, left_out)


@dataclass
class Table:
    """The rows of a topic, [messages, size], with increasing times."""

    times: list[int]
    rows: NDArray[Any]
    integers: bool
    names: tuple[str, ...]  # of the columns; empty: unknown
    left_out: int = 0  # messages before every name had occurred

    def in_order_of(self, names: tuple[str, ...], where: str, first: str) -> None:
        """Orders the columns by `names`, those in `first`. ValueError if there are other names."""
        if names == self.names:
            return
        same = sorted(names) == sorted(self.names)
        expected = f"{', '.join(names) or 'numbers without names'}, as in {first}"
        check(same, where, expected, ", ".join(self.names) or "numbers without names")
        self.rows = self.rows[:, [self.names.index(name) for name in names]]
        self.names = names
