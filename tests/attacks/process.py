"""What the kernel knows of a process: its memory and processor time."""

import os
import pathlib
import threading

MEGABYTE = 1 << 20
CLOCK_TICKS = os.sysconf("SC_CLK_TCK")


class Process:
    """A running process by its id."""

    def __init__(self, pid):
        self.pid = pid
        self._folder = pathlib.Path(f"/proc/{pid}")

    def _status(self, field):
        for line in (self._folder / "status").read_text().splitlines():
            if line.startswith(f"{field}:"):
                return int(line.split()[1]) * 1024
        raise ProcessLookupError(self.pid)  # the process has ended

    def memory(self):
        """Returns the resident memory in bytes."""
        return self._status("VmRSS")

    def reset_peak(self):
        """Lets peak() start anew."""
        (self._folder / "clear_refs").write_text("5")

    def peak(self):
        """Returns the largest resident memory in bytes since reset_peak()."""
        return self._status("VmHWM")

    def processor_seconds(self):
        """Returns the processor time so far."""
        fields = (self._folder / "stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / CLOCK_TICKS


class MemoryWatch:
    """Kills a process whose resident memory exceeds a limit, so that an attack cannot exhaust the machine."""

    def __init__(self, process, limit_bytes):
        self._process = process
        self._limit = limit_bytes
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self):
        while not self._stopped.wait(0.05):
            try:
                if self._process.memory() > self._limit:
                    os.kill(self._process.pid, 9)
                    return
            except OSError:
                return

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stopped.set()
        self._thread.join()
