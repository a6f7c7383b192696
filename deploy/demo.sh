#!/usr/bin/env bash
# Starts a server with the shipped policies, lets a remote agent play CartPole with it, and stops the server. With PLAY=1 robots
# play three tasks on the status page until Ctrl-C.
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
  echo "$line"
  case $line in
    *'serving gRPC on '*) grpc=${line##* } ;;
    *'serving HTTP on '*) http=${line##* } ;;
  esac
done

"$bin/spikectl" policies --server="$grpc"

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

echo
echo "The status page is http://$http/ while the robot plays; make demo PLAY=1 keeps playing."
# A seed that training never uses: training draws seeds below 1,000,000, its evaluations below 2,000,000.
"$bin/spikectl" run --server="$grpc" --env=CartPole-v1 --episodes=20 --seed=3000000

echo
echo "What the server counted (http://$http/metrics):"
curl -sf "http://$http/metrics" | grep -E '^spikeserve_(decisions|spikes|energy_joules|episodes)_total'

stop
wait "$server" && echo "The server stopped cleanly."
trap - EXIT
