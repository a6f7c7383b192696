#!/usr/bin/env bash
# Starts a server with the shipped policies, lets a remote agent play CartPole with it, and stops the server.
#
# usage: deploy/demo.sh BIN_DIR
set -euo pipefail
cd "$(dirname "$0")/.."
bin=${1:?usage: deploy/demo.sh BIN_DIR}

exec {server_out}< <(exec "$bin/spikeserve" --policies=deploy/policies --listen=127.0.0.1:0 --http_listen=127.0.0.1:0)
server=$!
stop() { kill -TERM "$server" 2>/dev/null || true; }
trap stop EXIT

grpc='' http=''
while [[ -z $grpc || -z $http ]]; do
  read -r -t 30 line <&"$server_out" || { echo "demo: the server did not start" >&2; exit 1; }
  echo "$line"
  case $line in
    *'serving gRPC on '*) grpc=${line##* } ;;
    *'serving HTTP on '*) http=${line##* } ;;
  esac
done

# A seed that training never uses: training draws seeds below 1,000,000, its evaluations below 2,000,000.
"$bin/spikectl" policies --server="$grpc"
"$bin/spikectl" run --server="$grpc" --env=CartPole-v1 --episodes=20 --seed=3000000

echo
echo "What the server counted (http://$http/metrics):"
curl -sf "http://$http/metrics" | grep -E '^spikeserve_(decisions|spikes|energy_joules|episodes)_total'

stop
wait "$server" && echo "The server stopped cleanly."
trap - EXIT
