"""The machine of a server or a robot: a disk that becomes full, a time of day that jumps, and a computer that sleeps."""

import contextlib
import mmap
import pathlib
import struct
import subprocess

PAGE = 4096
SHIM = """
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

int clock_gettime(clockid_t clock, struct timespec* time) {
  static volatile long* seconds;
  if (seconds == NULL) {
    const int file = open(getenv("CLOCK_FILE"), O_RDONLY);
    seconds = mmap(NULL, 2 * sizeof(long), PROT_READ, MAP_SHARED, file, 0);
    close(file);
  }
  const int outcome = syscall(SYS_clock_gettime, clock, time);
  if (clock == CLOCK_REALTIME) time->tv_sec += seconds[0];
  if (clock == CLOCK_BOOTTIME) time->tv_sec += seconds[1];
  return outcome;
}
"""


class Clock:
    """The clocks of programs that start with `prefix`, which differ from those of the machine."""

    def __init__(self, folder: pathlib.Path):
        folder.mkdir(exist_ok=True)
        (folder / "shim.c").write_text(SHIM)
        subprocess.run(["cc", "-shared", "-fPIC", "-o", folder / "shim.so", folder / "shim.c"], check=True)
        (folder / "clock").write_bytes(bytes(16))
        self._file = (folder / "clock").open("r+b")
        self._seconds = mmap.mmap(self._file.fileno(), 16)
        self.prefix = ["env", f"LD_PRELOAD={folder}/shim.so", f"CLOCK_FILE={folder}/clock"]
        self._at = [0, 0]  # seconds

    def jump(self, seconds, asleep=0):
        """Moves the time of day, and lets the clock that counts the sleep of a computer jump."""
        self._at = [self._at[0] + seconds, self._at[1] + asleep]
        self._seconds[:] = struct.pack("qq", *self._at)


@contextlib.contextmanager
def small_disk(folder: pathlib.Path, size):
    """Yields the new `folder`, a file system of `size` bytes, or None if this process may not mount."""
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=False)
    if mounted.returncode != 0:
        yield None
        return
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


def fill(folder):
    """Leaves no room on the disk of `folder`. Returns the file that takes it."""
    filler = folder / "filler"
    with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while file.write(bytes(PAGE)):
            pass
    return filler
