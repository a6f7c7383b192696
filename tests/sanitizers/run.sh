#!/usr/bin/env bash
# Runs a load test of a sanitized server with a sanitized client, while another process reads the server's HTTP pages.
# Fails on any report of the sanitizer. The load is 1,000 sessions on 8 streams for DURATION, then 64 sessions that learn
# a shared fleet head by unary calls, then 64 sessions that learn their own heads in batches, ten seconds each.
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

# A report ends the process with status 66 and is written to the log. gRPC and protobuf are built without the sanitizer,
# so their own memory accesses are not checked.
export TSAN_OPTIONS="ignore_noninstrumented_modules=1:exitcode=66"
export ASAN_OPTIONS="detect_leaks=1:exitcode=66"
export UBSAN_OPTIONS="halt_on_error=1:exitcode=66:print_stacktrace=1"

exec {server_out}< <(exec "$bin/spikeserve" --policies=deploy/policies --listen=127.0.0.1:0 \
  --http_listen=127.0.0.1:0 2>"$log")
server=$!
trap 'kill -TERM "$server" 2>/dev/null || true' EXIT
grpc='' http=''
while [[ -z $http ]]; do
  read -r -t 120 line <&"$server_out" || { cat "$log" >&2; echo "sanitize: the server did not start" >&2; exit 1; }
  case $line in
    *'serving gRPC on '*) grpc=${line##* } ;;
    *'serving HTTP on '*) http=${line##* } ;;
  esac
done

while curl -sSf --fail-early -o /dev/null "http://$http/{metrics,status.json,sessions.json}"; do sleep 0.2; done &
reader=$!
trap 'kill -TERM "$reader" "$server" 2>/dev/null || true' EXIT

failed=''
load() {
  # A sanitized server is slow: with a thousand sessions, requests wait for a long time.
  "$bin/spikeload" --server="$grpc" --call_timeout=60s "$@" || failed+=" spikeload $*;"
}
load --sessions=1000 --streams=8 --mode=stream --duration="$duration"
# Short episodes, so that many of them end, and are merged into the fleet head, at the same time.
load --sessions=64 --streams=16 --mode=unary --policy=cartpole --learning_scope=fleet --episode_steps=5 --duration=10s
load --sessions=64 --streams=16 --mode=batch --policy=pendulum --learning_scope=session --episode_steps=5 --duration=10s

kill -TERM "$reader" || failed+=' the pages could not be read;'
kill -TERM "$server" || true
status=0
wait "$server" || status=$?
trap - EXIT
((status == 0)) || failed+=" the server ended with status $status;"
if [[ -n $failed ]] || grep -qE 'Sanitizer|runtime error' "$log"; then
  cat "$log" >&2
  echo "sanitize: $preset:${failed:- a report}" >&2
  exit 1
fi
echo "sanitize: $preset: no report"
