#!/usr/bin/env bash
# Serves the shipped policies, lets a remote agent play CartPole with them and prints the result. In a terminal the server
# and its status page then stay until Enter or Ctrl-C; otherwise it stops, so that scripts end. With PLAY=1 robots play three
# tasks on the status page until Ctrl-C.
#
# usage: [PLAY=1] deploy/demo.sh BIN_DIR
set -euo pipefail
cd "$(dirname "$0")/.."
bin=${1:?usage: deploy/demo.sh BIN_DIR}

exec {server_out}< <(exec "$bin/spikeserve" --policies=deploy/policies --listen=127.0.0.1:0 --http_listen=127.0.0.1:0)
server=$!
robots=()
# The server starts, so the programs wait for it, even if the machine is busy.
export SPIKECTL_CONNECT_TIMEOUT=60s
stop() { kill -TERM "${robots[@]}" "$server" 2>/dev/null || true; }
trap stop EXIT

grpc='' http=''
while [[ -z $grpc || -z $http ]]; do
  read -r -t 30 line <&"$server_out" || { echo "demo: the server did not start" >&2; exit 1; }
  case $line in
    *'serving gRPC on '*) grpc=${line##* } ;;
    *'serving HTTP on '*) http=${line##* } ;;
  esac
done

mapfile -t served < <("$bin/spikectl" policies --server="$grpc" | awk 'NR > 1 && $1 ~ "/" { print $1, $2 }')
fold -s -w 98 <<<"serving ${#served[@]} policies on $grpc: ${served[*]%% *}"

# Prints the address of the page that shows a robot's session.
print_page() {
  local session='' robot
  until [[ $session =~ \"session_id\":\"([0-9a-f]+)\" ]]; do
    for robot in "${robots[@]}"; do
      kill -0 "$robot" 2>/dev/null || { echo "demo: a robot stopped" >&2; exit 1; }
    done
    session=$(curl -sf "http://$http/sessions.json?filter=robot%3D$1") || session=''
    sleep 0.1
  done
  printf '  %-11s http://%s/#/sessions/%s\n' "$1" "$http" "${BASH_REMATCH[1]}"
}

if [[ ${PLAY:-0} != 0 ]]; then
  for task in CartPole-v1 Pendulum-v1 MountainCar-v0; do
    "$bin/spikectl" run --server="$grpc" --env="$task" --episodes=1000000 --seed=3000000 --rate=20 \
      --labels="robot=${task%-v?}" >/dev/null &
    robots+=($!)
  done
  echo
  echo "Robots play until Ctrl-C. The status page is http://$http/; watch a robot, and its spikes, here:"
  for task in CartPole Pendulum MountainCar; do print_page "$task"; done
  trap 'stop; wait; exit 0' INT TERM
  wait "$server"
  exit
fi

# Prints what a decision of the dense model of the same size costs, from the server's metrics: print_dense POLICY VERSION
print_dense() {
  curl -sf "http://$http/metrics" | awk -v policy="policy=\"$1\"" -v version="version=\"$2\"" -v model=int_sram_45nm '
    !index($1, policy) || !index($1, version) { next }
    /^spikeserve_decisions_total\{/ { decisions = $2 }
    !index($1, "energy_model=\"" model "\"") { next }
    /^spikeserve_dense_energy_joules\{/ { dense = $2 }
    /^spikeserve_energy_joules_total\{/ { energy = $2 }
    END { if (dense && energy && decisions)
      printf "dense model %.2f nJ a decision by %s, for the same size: %.0f times as much\n",
             dense * 1e9, model, dense * decisions / energy }'
}

for each in "${served[@]}"; do
  [[ $each == *' CartPole-v1' ]] && policy=${each% *} && break
done
# A seed that training never uses: training draws seeds below 1,000,000, its evaluations below 2,000,000.
"$bin/spikectl" run --server="$grpc" --env=CartPole-v1 --policy="${policy%/*}" --version="${policy#*/}" --episodes=20 \
  --seed=3000000 --quiet
print_dense "${policy%/*}" "${policy#*/}"

if [[ -t 0 && -t 1 ]]; then
  trap : INT TERM
  echo "status page http://$http/ until you press Enter"
  echo "next        make demo PLAY=1 shows three robots live; README.md calls the server from Python and C++"
  read -r || true
else
  echo "next        make demo PLAY=1 keeps the server and its status page; README.md calls it from Python and C++"
fi
stop
wait "$server"  # fails if the server did not stop cleanly
trap - EXIT
