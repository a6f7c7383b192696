#!/usr/bin/env bash
# Runs 1,000 sessions on 8 streams against the server, then 64 that learn one fleet's head, and 64 that learn heads of
# their own, all under a sanitizer; fails on any report.
#
# usage: tests/sanitizers/run.sh asan|tsan [DURATION]
set -euo pipefail
cd "$(dirname "$0")/../.."
preset=${1:?usage: tests/sanitizers/run.sh asan|tsan [DURATION]}
duration=${2:-60s}

cmake --preset "$preset" --log-level=WARNING
cmake --build "build/$preset" --target spikeserve spikeload
bin=build/$preset/bin
log=build/$preset/sanitizer-report.txt

# A report ends the process with status 66 and stands in the log. gRPC and protobuf are built without the sanitizer, so
# what they do themselves is not judged.
export TSAN_OPTIONS="ignore_noninstrumented_modules=1:exitcode=66:suppressions=tests/sanitizers/tsan_suppressions.txt"
export ASAN_OPTIONS="detect_leaks=1:exitcode=66"
export UBSAN_OPTIONS="halt_on_error=1:exitcode=66:print_stacktrace=1"

exec {server_out}< <(exec "$bin/spikeserve" --policies=deploy/policies --listen=127.0.0.1:0 \
  --http_listen=127.0.0.1:0 2>"$log")
server=$!
trap 'kill -TERM "$server" 2>/dev/null || true' EXIT
address=''
while [[ -z $address ]]; do
  read -r -t 120 line <&"$server_out" || { cat "$log" >&2; echo "sanitize: the server did not start" >&2; exit 1; }
  case $line in *'serving gRPC on '*) address=${line##* } ;; esac
done

load() {
  "$bin/spikeload" --server="$address" --duration="$duration" "$@"
}
load --sessions=1000 --streams=8 --mode=stream
# Short episodes, so that many end, and are merged, at once.
load --sessions=64 --streams=16 --mode=unary --policy=cartpole --learning_scope=fleet --episode_steps=5
load --sessions=64 --streams=16 --mode=unary --policy=pendulum --learning_scope=session --episode_steps=5
kill -TERM "$server"
status=0
wait "$server" || status=$?
trap - EXIT
if ((status != 0)) || grep -qE 'Sanitizer|runtime error' "$log"; then
  cat "$log" >&2
  echo "sanitize: $preset: the server ended with status $status" >&2
  exit 1
fi
echo "sanitize: $preset: no report"
