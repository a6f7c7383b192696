#!/usr/bin/env bash
# Tests the program spikereport with small sizes: runs, an interruption, and errors in one line.
#
# usage: spikereport_test.sh SPIKEREPORT
set -euo pipefail
spikereport=$1
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
cd "$dir"

fail() { echo "FAILED: $1" >&2; exit 1; }

# Runs the paper's experiments with small sizes, then once more from the finished runs.
"$spikereport" --smoke --out=report --seeds=2 --environments=CartPole-v1,Pendulum-v1 >/dev/null 2>&1
grep -q '"run":"Pendulum-v1-full-T4-N4-seed2"' report/runs.json || fail "runs.json"
grep -q '"membrane"' report/figures.json || fail "figures.json"
rm report/CartPole-v1-full-T4-N4-seed1/result.json  # interrupted after training
"$spikereport" --smoke --out=report --seeds=2 --environments=CartPole-v1,Pendulum-v1 2>&1 |
  grep -c 'training' | grep -qx 1 || fail "report trains a finished run again"
if "$spikereport" --smoke --out=report --seeds=2 --environments=CartPole-v1 --learning_rate=1 2>message; then
  fail "accepted: runs made with other options"
fi
grep -q 'expected a run of .* --learning_rate=1 .*, received one of ' message || fail "report: $(cat message)"
message=$("$spikereport" 2>&1) && fail "accepted: no --out"
[[ $message == "spikereport: --out: expected the directory to write into, received none" ]] || fail "$message"
