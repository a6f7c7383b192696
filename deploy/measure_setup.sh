#!/usr/bin/env bash
# Runs `make demo`, or another target, on this tree in a fresh root of Debian 12, and prints what that took: packages, disk,
# processor time and time. Needs root, debootstrap and a mirror of Debian.
#
# usage: deploy/measure_setup.sh [TARGET]
set -euo pipefail
cd "$(dirname "$0")/.."
target=${1:-demo}
if [[ -z ${MEASURE_INSIDE:-} ]]; then  # mounts of its own: nothing stays mounted, whatever happens
  MEASURE_INSIDE=1 exec unshare --mount --pid --fork --kill-child "$0" "$target"
fi
root=$(mktemp -d "${TMPDIR:-/tmp}/measure-setup.XXXXXX")
trap 'umount --lazy "$root/proc" "$root/dev" 2>/dev/null || true; rm -rf --one-file-system "$root"' EXIT

echo "measure-setup: making a root of Debian 12 with git and make"
debootstrap --variant=minbase --include=git,make bookworm "$root" >/dev/null
mkdir "$root/spikeserve"
git ls-files -z --cached --others --exclude-standard | tar -cf - --null --ignore-failed-read -T - | tar -xf - -C "$root/spikeserve"
cp /etc/resolv.conf "$root/etc/resolv.conf"
mount -t proc proc "$root/proc"
mount --rbind /dev "$root/dev"

packages() { chroot "$root" dpkg-query --show | wc -l; }
disk() { du --summarize --block-size=1M --one-file-system --exclude=spikeserve --exclude=cache "$root" | cut -f1; }
packages_before=$(packages) disk_before=$(disk)
echo "measure-setup: make $target with $(nproc) processors at a load of $(cut -d' ' -f1 /proc/loadavg)"
TIMEFORMAT='%R %U %S'
{ time env -i HOME=/root PATH="$PATH" chroot "$root" make -C /spikeserve "$target" </dev/null 2>&3; } 3>&2 2>"$root/took"
awk -v target="$target" -v packages=$(($(packages) - packages_before)) -v disk=$(($(disk) - disk_before)) '{
  print "| target | packages | disk | processor time | time |\n| --- | ---: | ---: | ---: | ---: |"
  printf "| make %s | %d | %d MB | %.1f minutes | %.1f minutes |\n", target, packages, disk, ($2 + $3) / 60, $1 / 60 }' "$root/took"
