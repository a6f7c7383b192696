#!/usr/bin/env bash
# Trains an Acrobot policy of the paper's size with two ticks, by DAgger as in acrobot.sh, and with few operations.
#
# usage: lab/recipes/acrobot-frugal.sh SPIKETRAIN OUT_DIR
environment=Acrobot-v1
source "$(dirname "$0")/recipe.sh"

expert=(--expert=lookahead --weigh)
data base --steps=60000 --expert_fraction=0.1 --disturbed_fraction=0.9 "${expert[@]}"

short=(--batch=64 --clip_steps=5 --slope=4)
# Records the states that the policy itself reaches, with the expert's labels.
round() { data "$1" --seed="$2" --steps=100000 --expert_fraction=0 --student="$policy" "${expert[@]}"; }
stage 1-two base --seed=1 --iterations=3000 --learning_rate=2e-3 --mode=baseline --norm=fade --ticks=2 "${short[@]}"
round round1 1
stage 2-two base,round1 --seed=2 --iterations=4000 --learning_rate=2e-3 "${short[@]}"
round round2 2
stage 3-quiet base,round1,round2 --seed=3 --iterations=5000 --learning_rate=1e-3 --target_rate=5 --readout_rate=20 \
  --operation_penalty=0.01 "${short[@]}"
round round3 3
stage 4-quieter base,round1,round2,round3 --seed=4 --iterations=8000 --learning_rate=1e-3 --target_rate=3 --readout_rate=15 \
  --operation_penalty=0.02 "${short[@]}"
round round4 4
stage 5-quieter base,round2,round3,round4 --seed=5 --iterations=10000 --learning_rate=7e-4 --target_rate=3 --readout_rate=15 \
  --operation_penalty=0.02 "${short[@]}"
round round5 5
stage 6-own base,round1,round2,round3,round4,round5 --seed=6 --iterations=8000 --learning_rate=1e-3 --target_rate=4 --readout_rate=18 \
  --operation_penalty=0.005 "${short[@]}"

unseen
integer
