#!/usr/bin/env bash
# Runs a file of tests with the Python that tests/interop/install.sh makes. Without it: status 77, which ctest counts as
# skipped, or a failure in CI.
#
# usage: tests/interop/run.sh PYTHON FILE [PYTEST_FLAG...]
set -euo pipefail
python=${1:?usage: tests/interop/run.sh PYTHON FILE}
if [[ ! -x $python ]]; then
  echo "$python: expected what \`deploy/setup.sh\` installs, found none" >&2
  [[ -z ${CI:-} ]] && exit 77
  exit 1
fi
exec "$python" -m pytest -q -p no:cacheprovider "${@:2}"
