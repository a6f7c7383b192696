#!/usr/bin/env bash
# Runs load tests and Python tests of a sanitized server. Fails on any report of the sanitizer, of any process: a report is
# a file in build/PRESET/reports, so it is noticed even if a test kills the process or ignores its output.
#
# The load tests run a sanitized client, while another process reads the server's HTTP pages. Over plain text and then over
# TLS, the load is 1,000 sessions on 8 streams for DURATION, 64 sessions that learn a shared fleet head by unary calls, and
# 64 sessions that learn their own heads in batches, ten seconds each. The Python tests are those named below.
#
# usage: tests/sanitizers/run.sh asan|tsan [DURATION [TESTS]]   TESTS: a regular expression of names of Python tests
set -euo pipefail
cd "$(dirname "$0")/../.."
preset=${1:?usage: tests/sanitizers/run.sh asan|tsan [DURATION [TESTS]]}
duration=${2:-60s}

# What threads of the server share: the HTTP pages, budgets, recordings, roll-outs, stores, and the log of shared heads.
# Tests that measure the speed of the server are not here.
python_tests=(
  test_explain_turns test_fleet_attack test_fleet_learning test_fleet_log test_late_replies test_learning test_limits
  test_operator test_promotion test_recording_queue test_redis_kinds test_redis_store test_session_store
  test_shared_settings test_status_json test_tenants test_tls test_tokens
)
# These measure memory, and the address sanitizer keeps freed memory for a while.
[[ $preset == asan ]] || python_tests+=(test_budgets test_http_attacks)
tests=${3:-^($(IFS='|'; echo "${python_tests[*]}"))\$}

cmake --preset "$preset" --log-level=WARNING
cmake --build "build/$preset" --target spikeserve spikeload spikectl client_player golden_test
# The answers of another build type.
"build/$preset/tests/golden_test" --gtest_brief=1
bin=build/$preset/bin
log=build/$preset/sanitized-server.txt
reports=$PWD/build/$preset/reports
tls=build/$preset/tls
: >"$log"
rm -rf "$reports"
mkdir -p "$reports"

# A report ends the process with status 66. gRPC and protobuf are built without the sanitizer, so their own memory accesses
# are not checked.
report=exitcode=66:log_path=$reports/report
export TSAN_OPTIONS="ignore_noninstrumented_modules=1:$report"
export ASAN_OPTIONS="detect_leaks=1:$report"
export UBSAN_OPTIONS="halt_on_error=1:print_stacktrace=1:$report"

failed=''
server='' reader=''
trap 'kill -TERM $reader $server 2>/dev/null || true' EXIT

# Starts the server with the flags "$@" and sets `server`, `grpc` and `http`.
start_server() {
  local server_out line
  exec {server_out}< <(exec "$bin/spikeserve" --policies=deploy/policies --listen=127.0.0.1:0 \
    --http_listen=127.0.0.1:0 "$@" 2>>"$log")
  server=$!
  grpc='' http=''
  while [[ -z $http ]]; do
    read -r -t 120 line <&"$server_out" || { cat "$log" >&2; echo "sanitize: the server did not start" >&2; exit 1; }
    case $line in
      *'serving gRPC on '*) grpc=${line##* } ;;
      *'serving HTTP on '*) http=${line##* } ;;
    esac
  done
}

# Puts the load on the server, with `client_flags`, while the pages are read from $1, and stops it.
load_server() {
  while curl -sSf --fail-early "${curl_flags[@]}" -o /dev/null "$1://$http/{metrics,status.json,sessions.json}"; do
    sleep 0.2
  done &
  reader=$!
  # A sanitized server is slow: with a thousand sessions, requests wait for a long time.
  load --sessions=1000 --streams=8 --mode=stream --duration="$duration"
  # Short episodes, so that many of them end, and are merged into the fleet head, at the same time.
  load --sessions=64 --streams=16 --mode=unary --policy=cartpole --learning_scope=fleet --episode_steps=5 --duration=10s
  load --sessions=64 --streams=16 --mode=batch --policy=pendulum --learning_scope=session --episode_steps=5 \
    --duration=10s
  kill -TERM "$reader" || failed+=" the pages could not be read over $1;"
  kill -TERM "$server" || true
  local status=0
  wait "$server" || status=$?
  ((status == 0)) || failed+=" the server ended with status $status;"
}

load() {
  "$bin/spikeload" --server="$grpc" --call_timeout=60s "${client_flags[@]}" "$@" || failed+=" spikeload $*;"
}

client_flags=() curl_flags=()
start_server
load_server http

mkdir -p "$tls"
openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 1 -subj /CN=localhost \
  -addext subjectAltName=IP:127.0.0.1 -keyout "$tls/key.pem" -out "$tls/certificate.pem" 2>/dev/null
client_flags=("--tls_ca=$tls/certificate.pem") curl_flags=(--cacert "$tls/certificate.pem")
start_server "--tls_certificate=$tls/certificate.pem" "--tls_key=$tls/key.pem"
load_server https
server='' reader=''

ctest --test-dir "build/$preset" --output-on-failure --no-tests=error --tests-regex "$tests" || failed+=' a Python test;'

for file in "$reports"/*; do
  [[ -e $file ]] || continue
  failed+=" ${file#"$PWD/"};"
  cat "$file" >&2
done
if [[ -n $failed ]]; then
  cat "$log" >&2
  echo "sanitize: $preset:$failed" >&2
  exit 1
fi
echo "sanitize: $preset: no report"
