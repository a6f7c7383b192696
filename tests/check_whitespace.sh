#!/usr/bin/env bash
# Fails if a tracked text file has trailing whitespace, blank lines at its end, or no newline at its end. .gitattributes
# exempts vendored and generated files.
set -euo pipefail
cd "$(dirname "$0")/.."
status=0
empty=$(git hash-object -t tree /dev/null)
git diff --check "$empty" || status=1
unended=$(git grep -zIl '' -- ':(exclude,attr:-whitespace)' | xargs -0 grep -LPz '\n\z' || true)
if [[ -n $unended ]]; then
  sed 's/$/: expected a newline at the end of the file/' <<<"$unended"
  status=1
fi
exit $status
