#!/bin/bash
# Plays a newcomer in a clean root: run.sh CHECKOUT PYTHON [PAGE...]
#
# CHECKOUT is this repository after `make build`, PYTHON the interpreter with the packages of tests/python/requirements.txt.
# The root is an overlay of this machine's files with an empty /tmp and an empty home, in its own namespaces of mounts,
# processes and network: nothing changes the machine, and the pages' ports are free. There is no network, so pip finds the
# packages of others in PYTHON's folder instead of an index. Exits with 77 where it may not make namespaces.
set -euo pipefail
checkout=$(realpath "$1")
python=$2
shift 2
if [[ -z ${NEWCOMER_OUTSIDE:-} ]]; then
  unshare --mount --net --pid --fork true || exit 77
  NEWCOMER_OUTSIDE=$(mktemp -d)
  export NEWCOMER_OUTSIDE
  trap 'rm -rf "$NEWCOMER_OUTSIDE"' EXIT
  unshare --mount --net --pid --fork --kill-child "$0" "$checkout" "$python" "$@"
  exit
fi

packages=$("$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
root=$NEWCOMER_OUTSIDE/root
mkdir "$NEWCOMER_OUTSIDE"/{upper,work,root}
mount -t overlay overlay -o "lowerdir=/,upperdir=$NEWCOMER_OUTSIDE/upper,workdir=$NEWCOMER_OUTSIDE/work" "$root"
mount --rbind /dev "$root/dev"
mount -t proc proc "$root/proc"
mount -t tmpfs -o mode=1777 tmpfs "$root/tmp"
# A checkout has no ignored files but those of the build.
git -C "$root$checkout" clean -qfdX --exclude='!/build'
# What `make build` makes is there, and building takes an hour.
mkdir -p "$root/usr/local/bin" "$root/home/newcomer"
printf '#!/bin/sh\n[ "$*" = build ]\n' >"$root/usr/local/bin/make"
chmod +x "$root/usr/local/bin/make"
ip link set lo up
exec env -i PATH=/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/home/newcomer LANG=C.UTF-8 \
  PIP_NO_INDEX=1 PIP_NO_BUILD_ISOLATION=0 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_QUIET=1 PYTHONPATH="$packages" \
  MPLBACKEND=Agg CMAKE_BUILD_PARALLEL_LEVEL="${CMAKE_BUILD_PARALLEL_LEVEL:-}" \
  chroot "$root" /bin/bash -c 'cd "$1" && shift && exec python3 tests/newcomer/play.py "$@"' play "$checkout" "$@"
