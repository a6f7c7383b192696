#!/usr/bin/env bash
# Trains the shipped Acrobot policy by DAgger. After each round of training the policy plays, and the expert labels the
# states that it reached. From the second round on, training also reduces the spikes.
#
# usage: lab/recipes/acrobot.sh SPIKETRAIN OUT_DIR
environment=Acrobot-v1
source "$(dirname "$0")/recipe.sh"

# An imitating policy loses most of its return in the chaotic states before the goal. Most choices there do not matter
# and a few matter a lot, so the labels are weighted.
expert=(--expert=lookahead --weigh)
data base --steps=60000 --expert_fraction=0.1 --disturbed_fraction=0.9 "${expert[@]}"

# The current state is sufficient for the decision, so short clips give the same policy in a third of the time.
short=(--slope=4 --batch=64 --clip_steps=5 --learning_rate=2e-3)
stage 1-play base --mode=full --seed=1 --iterations=600 "${short[@]}"
data round1 --seed=1 --steps=40000 --expert_fraction=0 --student="$policy" "${expert[@]}"
stage 2-quiet base,round1 --seed=2 --iterations=400 --target_rate=1.8 --readout_rate=10 "${short[@]}"
data round2 --seed=2 --steps=40000 --expert_fraction=0 --student="$policy" "${expert[@]}"
stage 3-quieter base,round1,round2 --seed=3 --iterations=500 --target_rate=1 --readout_rate=8 "${short[@]}"
data round3 --seed=3 --steps=40000 --expert_fraction=0 --student="$policy" "${expert[@]}"
stage 4-whole base,round1,round2,round3 --seed=4 --iterations=350 --target_rate=1 --readout_rate=8 --slope=4 --batch=16 \
  --learning_rate=1.5e-3
data round4 --seed=4 --steps=40000 --expert_fraction=0 --student="$policy" "${expert[@]}"
stage 5-whole base,round1,round2,round3,round4 --seed=5 --iterations=400 --target_rate=1.2 --readout_rate=8 --slope=4 \
  --batch=16 --learning_rate=2e-3
# Leaves out the data of the first rounds, whose states are those of worse policies.
data round5 --seed=5 --steps=80000 --expert_fraction=0 --student="$policy" "${expert[@]}"
stage 6-loud base,round5 --seed=6 --iterations=1200 --target_rate=3 --readout_rate=15 "${short[@]}"
data round6 --seed=6 --steps=60000 --expert_fraction=0 --student="$policy" "${expert[@]}"
stage 7-quiet base,round5,round6 --seed=7 --iterations=800 --target_rate=1.8 --readout_rate=10 "${short[@]}"
data round7 --seed=7 --steps=60000 --expert_fraction=0 --student="$policy" "${expert[@]}"
stage 8-whole base,round5,round6,round7 --seed=8 --iterations=500 --target_rate=1.5 --readout_rate=10 --slope=4 \
  --batch=16 --learning_rate=1.5e-3

unseen
integer
