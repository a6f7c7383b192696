#!/usr/bin/env bash
# Builds this working tree in a clean root with a release of Debian, once with each compiler, with warnings as errors, and
# runs the golden answers and the parity of the engines. Run it as root. The root stays in build/debian-RELEASE, with its
# compiler cache, so that the next run is quick.
#
# usage: tests/debian/build.sh RELEASE COMPILER...    for example: build.sh trixie g++ clang++ g++-13
#   TARGETS="golden_test" builds only these, and runs those of the tests that are among them; default: everything
set -euo pipefail
cd "$(dirname "$0")/../.."
release=$1
shift
root=$PWD/build/debian-$release
if [[ -z ${DEBIAN_OUTSIDE:-} ]]; then
  # Mounts of its own: nothing stays mounted, whatever happens.
  DEBIAN_OUTSIDE=1 exec unshare --mount --pid --fork --kill-child "$0" "$release" "$@"
fi

if [[ ! -e $root/etc/debian_version ]]; then
  rm -rf "$root.new"
  debootstrap --variant=minbase "$release" "$root.new" >/dev/null
  mv "$root.new" "$root"
fi
mkdir -p "$root/spikeserve"
# What the tree no longer has must not be built.
find "$root/spikeserve" -mindepth 1 -maxdepth 1 ! -name build -exec rm -rf {} +
git ls-files -z --cached --others --exclude-standard | tar -cf - --null --ignore-failed-read -T - | tar -xf - -C "$root/spikeserve"
cp /etc/resolv.conf "$root/etc/resolv.conf"
cp /etc/ssl/certs/ca-certificates.crt "$root/etc/authorities.crt"  # pip trusts the authorities of this machine

mount -t proc proc "$root/proc"
mount --rbind /dev "$root/dev"
# shellcheck disable=SC2016
inside='
set -euo pipefail
cd /spikeserve
targets=$1
shift
deploy/setup.sh build server build clang
for compiler in "$@"; do
  package=${compiler/clang++/clang}
  dpkg-query -W "$package" >/dev/null 2>&1 || apt-get install -y -qq --no-install-recommends "$package" >/dev/null
  "$compiler" --version | head -1
  train=ON
  [[ $compiler == g++* ]] || train=OFF
  # The static libraries of the release need the C++ library of its own GCC. An older one would link against its own.
  mkdir -p build/newest
  ln -sf /usr/lib/*-linux-gnu/libstdc++.so.6 build/newest/libstdc++.so
  # Since version 18 clang mangles some templates of Abseil otherwise than the GCC that Debian made it with.
  abi=
  [[ $compiler != clang* ]] || abi=-fclang-abi-compat=17
  cmake --preset release -B "build/$compiler" --log-level=WARNING "-DCMAKE_CXX_FLAGS=$abi" \
    "-DCMAKE_CXX_COMPILER=$compiler" "-DSPIKESERVE_BUILD_TRAIN=$train" "-DCMAKE_EXE_LINKER_FLAGS=-L$PWD/build/newest"
  # shellcheck disable=SC2086
  cmake --build "build/$compiler" ${targets:+--target $targets} -- -k 0  # shows all warnings
  for test in golden_test engine_parity_test; do
    [[ -z $targets || " $targets " == *" $test "* ]] || continue
    "build/$compiler/tests/$test" --gtest_brief=1
  done
done'
exec env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8 DEBIAN_FRONTEND=noninteractive \
  PIP_CERT=/etc/authorities.crt CCACHE_DIR=/var/cache/ccache CMAKE_BUILD_PARALLEL_LEVEL="${CMAKE_BUILD_PARALLEL_LEVEL:-}" \
  chroot "$root" /bin/bash -c "$inside" build "${TARGETS:-}" "$@"
