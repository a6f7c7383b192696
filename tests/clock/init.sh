#!/bin/sh
# The first process of the machine that tests/clock starts. Its files are those of the host, which it can only read;
# only /run is its own.
mount -t proc proc /proc
mount -t tmpfs tmpfs /run
ip link set lo up
export PYTHONDONTWRITEBYTECODE=1 HOME=/run TMPDIR=/run
cd "$CLOCK_ROOT" && "$CLOCK_PYTHON" -m tests.clock.steps
echo "clock: ended with status $?"
echo o >/proc/sysrq-trigger
sleep 60
