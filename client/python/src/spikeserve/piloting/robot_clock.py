"""The robot's clock, by which the age of an observation is measured.

It counts the time in which the computer was suspended, as a monotonic clock of Linux does not: an
observation is as old as it is, and the server, which compares the times of the robot with each
other, sees a clock that never stands still. Waits are measured by time.monotonic().
"""

from __future__ import annotations

import time

_BOOT_TIME = getattr(time, "CLOCK_BOOTTIME", None)  # Linux has it


def now_ns() -> int:
    """Returns nanoseconds since a fixed point in the past."""
    return time.monotonic_ns() if _BOOT_TIME is None else time.clock_gettime_ns(_BOOT_TIME)
