#!/usr/bin/env bash
# Fills a folder with everything that a release publishes: Debian packages, wheels and source distributions of the Python
# packages, the source archive, the notes, an SBOM, and SHA256SUMS. The same commit gives the same bytes.
#
# usage: deploy/release/make.sh OUT_DIR BUILD_DIR...
#   BUILD_DIR: a build with all programs; one for each architecture
#
# Wheels of the client and the engine are made for each CPython from 3.10 to 3.13 with headers that is in PATH or installed by pyenv.
# PYTHONS="3.11" selects others.
set -euo pipefail
usage="usage: $0 OUT_DIR BUILD_DIR..."
out=$(realpath -m "${1:?$usage}")
shift
(($#)) || { echo "$usage" >&2; exit 1; }
builds=()
for build in "$@"; do builds+=("$(realpath "$build")"); done
root=$(cd "$(dirname "$0")/../.." && pwd)
cd "$root"
python=$root/build/venv/bin/python
version=$(sed -n 's/^project(spikeserve VERSION \([0-9.]*\).*/\1/p' CMakeLists.txt)
umask 022
export LC_ALL=C.UTF-8 TZ=UTC
SOURCE_DATE_EPOCH=$(git log -1 --format=%ct)
export SOURCE_DATE_EPOCH
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
rm -rf "$out"
mkdir -p "$out"

say() { echo "dist: $*"; }

debian_packages() {
  say "Debian packages of $1"
  (cd "$1" && cpack -G DEB -B "$work/packages" >"$work/cpack.log") || { cat "$work/cpack.log" >&2; return 1; }
  mv "$work"/packages/*.deb "$out"
  rm -rf "$work/packages"
}

# Prints the path of a complete CPython $1, such as 3.12.
interpreter() {
  local candidate
  while read -r candidate; do
    if "$candidate" -c 'import ensurepip, pathlib, sys, sysconfig, venv
sys.exit(sys.implementation.name != "cpython" or not pathlib.Path(sysconfig.get_path("include"), "Python.h").is_file())' \
      >/dev/null 2>&1; then
      echo "$candidate"
      return
    fi
  done < <(type -ap "python$1"; find "${PYENV_ROOT:-$HOME/.pyenv}/versions" -path "*/$1.*/bin/python$1" 2>/dev/null | sort -V)
  return 1
}

# The source distribution of the engine holds the folders that it compiles, below the same pyproject.toml.
engine_sdist() {
  local stage=$work/engine engine=client/python/engine
  mkdir -p "$stage"
  git archive HEAD CMakeLists.txt LICENSE NOTICE cmake core "$engine" | tar -x -C "$stage"
  sed -e 's#\.\./\.\./\.\./build/wheel#build/wheel#; s#"\.\./\.\./\.\."#"."#; s#"\.\./\.\./\.\./CMakeLists#"CMakeLists#' \
    -e "s#\"src/spikeserve_engine\"#\"$engine/src/spikeserve_engine\"#" "$stage/$engine/pyproject.toml" >"$stage/pyproject.toml"
  rm "$stage/$engine/pyproject.toml"
  (cd "$stage" && "$python" -c "import scikit_build_core.build as build; build.build_sdist('$out')" >/dev/null)
}

python_packages() {
  local name found pythons=()
  say "Python packages"
  git clone --quiet "$root" "$work/clone"  # wheels keep the modes of their sources
  for name in client train; do
    (cd "$work/clone/$name/python" && "$python" -c "import hatchling.build as build; build.build_sdist('$out')" >/dev/null)
  done
  engine_sdist
  "$python" -m pip wheel --quiet --disable-pip-version-check --no-build-isolation --no-deps --wheel-dir="$out" \
    "$work/clone/train/python"
  for name in ${PYTHONS-3.10 3.11 3.12 3.13}; do
    if found=$(interpreter "$name"); then
      pythons+=("$found")
    else
      say "no wheels for CPython $name: expected one with headers in PATH or pyenv, found none"
    fi
  done
  ((${#pythons[@]})) || return 0
  say "wheels of the client and the engine for ${pythons[*]}"
  # At the depth of build/release, so that the compiler cache knows the core that was compiled there.
  CXX=g++ CMAKE_CXX_COMPILER_LAUNCHER=ccache SKBUILD_BUILD_DIR="$work/clone/build/wheel" CCACHE_BASEDIR="$work/clone" \
    CCACHE_NOHASHDIR=1 "$work/clone/client/python/build_wheels.sh" "$out" "$python" "${pythons[@]}" >"$work/wheels.log" 2>&1 ||
    { cat "$work/wheels.log" >&2; return 1; }
}

# What Rust and Go add to the Debian packages of the robot's end.
robot_sources() {
  local language name
  say "crate and Go module"
  for language in rust go; do
    name=spikeserve-robot-$language-$version
    mkdir "$work/$name"
    git archive HEAD:client/$language | tar -x -C "$work/$name"
    git show HEAD:LICENSE >"$work/$name/LICENSE"
    tar -C "$work" --sort=name --mtime="@$SOURCE_DATE_EPOCH" --owner=0 --group=0 --numeric-owner -c "$name" | gzip -9n >"$work/$name.tgz"
  done
  mv "$work/spikeserve-robot-rust-$version.tgz" "$out/spikeserve-robot-$version.crate"
  mv "$work/spikeserve-robot-go-$version.tgz" "$out"
}

for build in "${builds[@]}"; do debian_packages "$build"; done
python_packages
robot_sources
say "source archive, notes, SBOM and checksums"
git archive --prefix="spikeserve-$version/" HEAD | gzip -9n >"$out/spikeserve-$version.src.tar.gz"
/usr/bin/python3 deploy/release/notes.py CHANGELOG.md "$version" >"$out/RELEASE_NOTES.md"
/usr/bin/python3 deploy/release/sbom.py "$out" "$version" "${builds[0]}/bin" >"$work/sbom.json"
mv "$work/sbom.json" "$out/spikeserve-$version.spdx.json"
(cd "$out" && sha256sum -- * >"$work/SHA256SUMS" && mv "$work/SHA256SUMS" .)
say "$(find "$out" -type f | wc -l) files in $out"
