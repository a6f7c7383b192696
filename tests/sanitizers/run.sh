#!/usr/bin/env bash
# Runs load tests of a sanitized server with a sanitized client, while another process reads the server's HTTP pages.
# Fails on any report of the sanitizer. Over plain text and then over TLS, the load is 1,000 sessions on 8 streams for
# DURATION, 64 sessions that learn a shared fleet head by unary calls, and 64 sessions that learn their own heads in
# batches, ten seconds each.
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
tls=build/$preset/tls
: >"$log"

# A report ends the process with status 66 and is written to the log. gRPC and protobuf are built without the sanitizer,
# so their own memory accesses are not checked.
export TSAN_OPTIONS="ignore_noninstrumented_modules=1:exitcode=66"
export ASAN_OPTIONS="detect_leaks=1:exitcode=66"
export UBSAN_OPTIONS="halt_on_error=1:exitcode=66:print_stacktrace=1"

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

if [[ -n $failed ]] || grep -qE 'Sanitizer|runtime error' "$log"; then
  cat "$log" >&2
  echo "sanitize: $preset:${failed:- a report}" >&2
  exit 1
fi
echo "sanitize: $preset: no report"
