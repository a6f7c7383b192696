#!/usr/bin/env bash
# Builds programs, libraries and the Python wheels twice from the current commit, without the compiler cache, in folders
# with different names, with different locales, time zones, masks of new files and numbers of jobs. Fails unless both
# builds give the same bytes, and keeps the folders then. The wheels need build/venv.
#
# usage: tests/check_reproducible.sh [TARGET...]
#   TARGET: a program, a library of the C++ client, or wheels; default: spikeserve spikectl spikeload wheels
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
targets=("$@")
(($#)) || targets=(spikeserve spikectl spikeload wheels)
work=$(mktemp -d)
export CCACHE_DISABLE=1
unset CCACHE_BASEDIR CCACHE_NOHASHDIR
# pip takes the times of the files in a wheel from this.
SOURCE_DATE_EPOCH=$(git -C "$root" log -1 --format=%ct)
export SOURCE_DATE_EPOCH

compiled=() train=OFF wheels=()
for target in "${targets[@]}"; do
  case $target in
    wheels) wheels=(./client/python ./client/python/engine) ;;
    spiketrain) compiled+=("$target") train=ON ;;
    *) compiled+=("$target") ;;
  esac
done

# Builds the targets from a clone in $1 with $2 jobs, and copies what it has built to $1/built. Other arguments are
# variables of the environment.
build() {
  local folder=$1 jobs=$2 target
  shift 2
  (umask 022 && git clone --quiet "$root" "$folder")  # the wheel of the engine keeps the modes of its sources
  mkdir "$folder/built"
  if ((${#compiled[@]})); then
    env -C "$folder" "$@" cmake --preset release --log-level=WARNING \
      -DSPIKESERVE_BUILD_TESTS=OFF -DSPIKESERVE_BUILD_PYTHON=OFF "-DSPIKESERVE_BUILD_TRAIN=$train" >/dev/null
    env -C "$folder" "$@" cmake --build build/release -j"$jobs" --target "${compiled[@]}"
  fi
  for target in "${compiled[@]}"; do
    find "$folder/build/release" -type f \( -path "*/bin/$target" -o -name "lib$target.a" \) -exec cp {} "$folder/built" \;
  done
  # The requirements of the tests include the build tools, so pip needs no network.
  if ((${#wheels[@]})); then
    env -C "$folder" "$@" CMAKE_BUILD_PARALLEL_LEVEL="$jobs" "$root/build/venv/bin/python" -m pip wheel --quiet \
      --disable-pip-version-check --no-build-isolation --no-deps --wheel-dir=built "${wheels[@]}"
  fi
}

fail() {
  echo "reproducible: $1; both builds are in $work" >&2
  exit 1
}

first=$work/a second="$work/another folder with a longer name"
umask 022
build "$first" "$(nproc)" TZ=UTC LC_ALL=C.UTF-8
umask 077
build "$second" 1 TZ=Pacific/Auckland LC_ALL=C

files=("$first"/built/*)
expected=$((${#compiled[@]} + ${#wheels[@]}))
((${#files[@]} == expected)) || fail "expected $expected files, received ${files[*]##*/}"
for file in "${files[@]}"; do
  name=${file##*/}
  cmp "$file" "$second/built/$name" || fail "$name: expected the same bytes, received others"
  # A path of the build would differ on another machine.
  ! grep -qaF "$work" "$file" || fail "$name: expected no path of the build, received one"
  (cd "$first/built" && sha256sum "$name")
done
rm -rf "$work"
