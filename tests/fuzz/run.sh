#!/usr/bin/env bash
# Searches with libFuzzer, under the address and undefined-behaviour sanitizers, for inputs that break a fuzz target.
# Keeps what it learns in build/fuzz/corpus, so that the next run continues from there. An input that breaks a target is
# written to tests/fuzz/corpus/TARGET: it is replayed by every later `make test`.
#
# usage: tests/fuzz/run.sh [SECONDS [TARGET...]]   60 seconds for each target, all targets
set -euo pipefail
cd "$(dirname "$0")/../.."
seconds=${1:-60}
shift || true

cmake --preset fuzz --log-level=WARNING
cmake --build build/fuzz --target fuzz_targets
programs=build/fuzz/tests/fuzz
export UBSAN_OPTIONS="halt_on_error=1:print_stacktrace=1"
# With entropic scheduling, libFuzzer compares each feature of an input with all features that it takes for rare, which
# takes a hundred times as long as the target where inputs have thousands of features.
failed=''
for target in "${@:-$(basename --multiple --suffix=_fuzz "$programs"/*_fuzz)}"; do
  for name in $target; do
    corpus=build/fuzz/corpus/$name found=tests/fuzz/corpus/$name
    "$programs/${name}_replay" --write_seeds="$corpus"
    mkdir -p "$found"
    echo "fuzz: $name, $seconds s"
    TIMEFORMAT="processor time: %U s"
    time "$programs/${name}_fuzz" -entropic=0 -max_total_time="$seconds" -rss_limit_mb=2048 -timeout=30 \
      -print_final_stats=1 -artifact_prefix="$found/" "$corpus" "$found" 2>"build/fuzz/$name.log" || failed+=" $name"
    grep -E '^stat::(number_of_executed_units|average_exec|peak_rss)|DONE|SUMMARY|^==.*ERROR|: expected ' "build/fuzz/$name.log" || true
    rmdir --ignore-fail-on-non-empty "$found"
  done
done
[[ -z $failed ]] || { echo "fuzz: failed:$failed; see build/fuzz/TARGET.log" >&2; exit 1; }
echo "fuzz: nothing found"
