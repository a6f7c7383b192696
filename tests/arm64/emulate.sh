#!/usr/bin/env bash
# Runs an arm64 program with the libraries of build/arm64-root. Runs a program of this machine as it is, but so that the
# arm64 programs that it starts run too; this needs a kernel that passes them to qemu (binfmt_misc): one with Debian's
# binfmt-support, or Linux 6.7 or later and root.
#
# usage: tests/arm64/emulate.sh PROGRAM [ARGUMENT...]
set -euo pipefail
root=$(realpath "$(dirname "$0")/../../build/arm64-root")
export QEMU_LD_PREFIX=$root
qemu=$(command -v qemu-aarch64-static)
program=$(command -v "$1")
# Bytes 18 and 19 of an ELF file name the architecture: 183 is arm64.
if [[ $(od -An -tu1 -N20 "$program" | tr -s ' \n' ' ') == ' 127 69 76 70 '*' 183 0 ' ]]; then
  exec "$qemu" "$@"
fi

runs_arm64() { "$root/lib/ld-linux-aarch64.so.1" --version >/dev/null 2>&1; }
! runs_arm64 || exec "$@"
[[ -z ${ARM64_EMULATED:-} ]] || {
  echo "emulate: expected a kernel that starts qemu for arm64 programs, received $(uname -r); install binfmt-support" >&2
  exit 1
}
# Since Linux 6.7 each user namespace has its own list of such programs, so that this machine's stays as it is.
register=':arm64:M::\x7fELF\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00'
register+=':\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff'
ARM64_EMULATED=1 exec python3 "$(dirname "$0")/namespace.py" bash -c '
  mount -t binfmt_misc binfmt_misc /proc/sys/fs/binfmt_misc 2>/dev/null &&
    printf "%s:%s:F" "$1" "$2" >/proc/sys/fs/binfmt_misc/register || true
  shift 2
  exec "$@"' bash "$register" "$qemu" "$0" "$@"
