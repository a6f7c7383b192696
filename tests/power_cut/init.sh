#!/bin/sh
# The first process of the machine that tests/power_cut starts. Its files are those of the host, which it can only read;
# only /run is its own, and /run/disk, which outlives the machine.
mount -t proc proc /proc
mount -t tmpfs tmpfs /run
mkdir /run/disk
ip link set lo up
export PYTHONDONTWRITEBYTECODE=1 HOME=/run TMPDIR=/run
mount -t ext4 /dev/ubda /run/disk && cd "$POWER_ROOT" && "$POWER_PYTHON" -m tests.power_cut.agents
echo "power: ended with status $?"
echo o >/proc/sysrq-trigger
sleep 60
