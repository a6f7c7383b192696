#!/usr/bin/env bash
# Tests the program spiketrain with small sizes: data, training, resuming, fine-tuning, evaluation, and errors in one line.
#
# usage: spiketrain_test.sh SPIKETRAIN
set -euo pipefail
spiketrain=$1
releases=$(realpath "$(dirname "$0")/../../releases")
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
cd "$dir"
# Baselines, and the look at the data for whether changes of the observation help, take nine tenths of such a training.
judged=(--hidden_size=16 --heads=2 --ticks=4 --context=5 --batch=4 --episodes=2)
tiny=("${judged[@]}" --no_baselines --observation_changes=false)

fail() { echo "FAILED: $1" >&2; exit 1; }
# refuses MESSAGE COMMAND...: expects that the command fails and prints exactly this message to standard error.
refuses() {
  local expected=$1 message
  shift
  if message=$("$spiketrain" "$@" 2>&1 >/dev/null); then fail "accepted: $*"; fi
  [[ $message == "spiketrain: $expected" ]] || fail "$*: $message"
}

"$spiketrain" dataset --env=CartPole-v1 --steps=1500 --seed=3 --out=data.cbor --json | grep -q '"expert_steps": 1000'
"$spiketrain" expert --env=CartPole-v1 --episodes=3 --json | grep -q '"mean_return": 500.0'
refuses "expert: expected feedback or return_conditioned for CartPole-v1, received 'beam'" expert --expert=beam
refuses '--wide_start_fraction: expected 0 for CartPole-v1, received 0.25' dataset --out=x.cbor --wide_start_fraction=0.25
refuses 'unnamed: expected a directory named like a Minari dataset, NAME-v0, received unnamed' \
  dataset --out=unnamed --student=none  # before it reads the student
refuses '--policy_weight: expected --correction_weight beside it, received none' dataset --out=x.cbor --policy_weight=0
"$spiketrain" dataset --steps=300 --expert_fraction=0.2 --disturbed_fraction=0.5 --out=disturbed.cbor |
  grep -q '"disturbed_steps":'

"$spiketrain" dataset --steps=200 --expert_fraction=0.2 --out=cartpole-mixed-v0 >/dev/null
"$spiketrain" train --data=data.cbor,cartpole-mixed-v0 --out=both "${tiny[@]}" --iterations=2 --clip_steps=3 \
  >/dev/null 2>&1

"$spiketrain" train --data=data.cbor --out=whole "${tiny[@]}" --iterations=6 --validate_every=1 --json 2>/dev/null > whole.json
grep -q '"spikes_per_decision"' whole.json
grep -q '"first_seed": 1000000' whole.json
grep -q '"loss_fall"' whole.json

# A run of which only the last checkpoint is left, as if interrupted before it wrote its policy, resumes to the same
# policy and the same verdict, which needs the validations from before. The data may have moved.
cp -r whole resumed
rm resumed/policy.safetensors
"$spiketrain" train --data="$dir/data.cbor" --out=resumed "${tiny[@]}" --iterations=6 --validate_every=1 --resume --json \
  2>/dev/null >resumed.json
cmp <(grep -v '"policy_file"' whole.json) <(grep -v '"policy_file"' resumed.json)

# A checkpoint of another model, another start or other data is refused, also where all tensors have the same shapes.
resume_of() { "$spiketrain" train --resume --data="${data:-data.cbor}" --out="$1" "${tiny[@]}" --iterations=6 "${@:2}"; }
refuses_to_continue() {
  local out=$1 expected=$2
  if resume_of "$out" "${@:3}" >/dev/null 2>message; then fail "accepted: a checkpoint of another run than ${*:3}"; fi
  grep -qE "^spiketrain: $out/checkpoint.pt: to continue its run, expected $expected\$" message || fail "$(cat message)"
}
LC_ALL=C sed 's/\xfa\x3f\x80/\xfa\x3f\xc0/g' data.cbor >earning.cbor  # rewards of 1.5 in the place of 1
refuses_to_continue resumed 'ticks=4, received ticks=5' --ticks=5
refuses_to_continue resumed 'phase_clock=timestep, received phase_clock=window' --phase_clock=window
refuses_to_continue resumed 'return_scale=250, received return_scale=100' --return_scale=100
refuses_to_continue resumed 'none, received --lookback=2' --lookback=2
data=earning.cbor refuses_to_continue resumed 'data_sha256=[0-9a-f]{64}, received data_sha256=[0-9a-f]{64}'
refuses_to_continue resumed 'none, received parent_sha256=[0-9a-f]{64}' --init=whole/policy.safetensors
resume_of resumed >/dev/null 2>&1 || fail "the same run"
# Data that are recorded anew are the same if their recipe is.
anew() {
  "$spiketrain" train --resume --out=anew "${tiny[@]}" --iterations=1 --expert_fraction=0.2 "$@" >/dev/null 2>message
}
for _ in 1 2; do anew --steps=200 || fail "the same recipe: $(cat message)"; done
if anew --steps=400; then fail "accepted: a checkpoint of another recipe"; fi
grep -q 'anew/checkpoint.pt: to continue its run, expected data=' message || fail "$(cat message)"

# The record of a policy identifies the program and the files that it was made from.
sha() { sha256sum "$1" | cut -d' ' -f1; }
says() { grep -qaF "$2" "$1" || fail "$1 does not contain $2"; }
"$spiketrain" dataset --steps=60 --expert_fraction=0.2 --student=whole/policy.safetensors --out=student.cbor >/dev/null
"$spiketrain" train --data=data.cbor,student.cbor --init=whole/policy.safetensors --out=child "${tiny[@]}" --iterations=1 \
  >/dev/null 2>&1
child=child/policy.safetensors
says $child "\\\"parent_sha256\\\":\\\"$(sha whole/policy.safetensors)\\\""
says $child "\\\"data_sha256\\\":{\\\"data.cbor\\\":\\\"$(sha data.cbor)\\\",\\\"student.cbor\\\":\\\"$(sha student.cbor)\\\"}"
says $child "\\\"student_sha256\\\":\\\"$(sha whole/policy.safetensors)\\\""
grep -qaE '\\"commit\\":\\"([0-9a-f]{40}(-dirty)?|unknown)\\"' $child || fail "the commit of the program"

# The end of a training shows what was made, and why the policy is asked for this return.
"$spiketrain" train --data=data.cbor --out=told "${tiny[@]}" --iterations=1 --validation=0 >told.txt 2>told.err
grep -qx 'policy: told/policy.safetensors' told.txt || fail "the path: $(cat told.txt)"
grep -q '^shape: 4 observations, 2 actions; mode full, hidden size 16, 2 heads' told.txt || fail "the shape"
grep -qx 'target return: 500, the default for CartPole-v1; --target_return sets another' told.txt || fail "the target"
grep -q '^closed-loop play: CartPole-v1, 2 episodes' told.txt || fail "the play"
grep -q 'spikes per decision' told.txt || fail "the spikes"
! grep -q validation told.txt told.err || fail "a validation without data for it"
cp -r whole replaced
"$spiketrain" train --data=data.cbor --out=replaced "${tiny[@]}" --iterations=1 --validation=0 --overwrite >/dev/null 2>&1
[[ ! -e replaced/learning_curve.csv ]] || fail "the losses of a run that was replaced"
OPENBLAS_CORETYPE=Prescott "$spiketrain" train --data=data.cbor --out=asked "${tiny[@]}" --iterations=1 --target_return=321 2>asked.err |
  grep -qx 'target return: 321, from --target_return' || fail "--target_return"
if [[ $(uname -m) == x86_64 ]] && grep -qw avx2 /proc/cpuinfo; then
  grep -q '^OpenBLAS .* OPENBLAS_CORETYPE=Haswell ' asked.err || fail "the advice on kernels: $(cat asked.err)"
fi
"$spiketrain" eval --policy=asked/policy.safetensors --episodes=1 >/dev/null
# An environment that spiketrain cannot play: the data of CartPole under another name of the same length.
LC_ALL=C sed 's/CartPole-v1/MyRobot1-v1/g' disturbed.cbor >other.cbor
"$spiketrain" train --data=other.cbor --out=other "${judged[@]}" --iterations=1 >other.txt 2>/dev/null
grep -q '"kind":"mlp"' other/baselines.json || fail "the weights of the baselines"
grep -q '^target return: .*, the best return in the data; ' other.txt || fail "the target of the data: $(cat other.txt)"
grep -q '^spikes per decision: [1-9].* on the observations of the data' other.txt || fail "the spikes on the data"
grep -q '^closed-loop play: skipped, because spiketrain does not have MyRobot1-v1. Serve the policy' other.txt ||
  fail "the play that was skipped"
"$spiketrain" train --data=other.cbor --out=other "${tiny[@]}" --iterations=1 --overwrite --json 2>/dev/null |
  grep -q '"closed_loop_play": "skipped"' || fail "the JSON of a play that was skipped"
# A delay: the labels of later steps are imitated, and the evaluation plays with it.
"$spiketrain" train --data=data.cbor --out=late "${judged[@]}" --observation_changes=false --iterations=2 --delay=0..2 --json 2>/dev/null >late.json
tr -d ' \n' <late.json | grep -q '"delay":\[0,2\]' || fail "the delay of the evaluation: $(cat late.json)"
! grep -q baselines late.json || fail "baselines beside a delay"
for delay in 2..0 x 1.. ..3 -1 1.5 0..1001 ""; do
  refuses "--delay: expected 0 to 1000 steps, as a number like 3 or a range like 0..5, received $delay" \
    train --data=data.cbor --out=x "--delay=$delay"
done
"$spiketrain" dataset --steps=20 --expert_fraction=0 --out=short.cbor >/dev/null
if "$spiketrain" train --data=short.cbor --out=x "${tiny[@]}" --delay=900 2>message; then fail "a delay beyond all data"; fi
grep -qE '^spiketrain: --delay: expected fewer steps than the longest episode has, [0-9]+, received 900$' message ||
  fail "a delay beyond all data: $(cat message)"

# A finished policy and its checkpoint are not replaced unasked.
before=$(sha other/policy.safetensors)
refuses "--out: expected another directory, --resume to continue the run, or --overwrite to replace it, received one with \
other/checkpoint.pt" train --data=other.cbor --out=other "${tiny[@]}" --iterations=2
cp -r other bare
rm bare/checkpoint.pt
refuses "--out: expected another directory, or --overwrite to replace it, received one with bare/policy.safetensors" \
  train --data=other.cbor --out=bare "${tiny[@]}" --iterations=1 --resume
refuses "--overwrite: expected no such flag beside --resume" \
  train --data=other.cbor --out=other "${tiny[@]}" --overwrite --resume
[[ $before == $(sha other/policy.safetensors) ]] || fail "a refused training changed the policy"

# Baselines stand beside the policy, and the change of the observation is used where the data need it.
grep -q '^error on [0-9]* held-out steps (share of other actions' other.txt || fail "the errors: $(cat other.txt)"
for name in 'the policy' 'line on 1 frame' 'line on 4 frames' 'mlp on 2 frames'; do
  grep -q "^  $name  *0\.[0-9]" other.txt || fail "the error of $name"
done
grep -qE '^verdict: (bad|weak|good): it explains -?[0-9]+ % of the actions of held-out steps, the best baseline' other.txt ||
  fail "the verdict: $(cat other.txt)"
if "$spiketrain" train --data=other.cbor --out=required "${judged[@]}" --iterations=1 --require=good >required.txt 2>message; then
  fail "a bad policy passed --require=good: $(cat required.txt)"
fi
grep -qE '^spiketrain: --require: expected a verdict of good or better, received (bad|weak): ' message || fail "$(cat message)"
[[ -s required/policy.safetensors ]] || fail "no policy beside a verdict that was refused"
"$spiketrain" train --data=data.cbor --out=plain "${tiny[@]}" --iterations=1 >plain.txt 2>/dev/null
! grep -q '^error on' plain.txt || fail "baselines with --no_baselines"
[[ ! -e plain/baselines.json ]] || fail "baselines.json with --no_baselines"
"$spiketrain" train --data=data.cbor --out=changes "${tiny[@]}" --iterations=1 --observation_changes=true 2>/dev/null |
  grep -q '^shape: .*, observation changes$' || fail "--observation_changes"
says changes/policy.safetensors '\"observation_changes\":true'
"$spiketrain" eval --policy=changes/policy.safetensors --episodes=1 --ablate=changes >/dev/null
"$spiketrain" quantize --policy=changes/policy.safetensors --out=changes8.safetensors --episodes=1 --allow_loss >/dev/null
refuses "--ablate: expected a policy with observation changes, received one without" \
  eval --policy=plain/policy.safetensors --episodes=1 --ablate=changes
refuses "--observation_changes: expected what --init has, true, or no such flag, received false" \
  train --data=data.cbor --init=changes/policy.safetensors --out=x --observation_changes=false
refuses '--observation_changes: expected true or false, received "2x"' train --out=x --observation_changes=2x

refuses '--target_return: expected a finite number, received inf' train --data=data.cbor --out=x --target_return=inf
refuses '--return_offset: expected a finite number, received nan' train --data=data.cbor --out=x --return_offset=nan --return_scale=nan
refuses '--return_scale: expected what --init has, 250, or no such flag, received 7' \
  train --data=data.cbor --init=whole/policy.safetensors --out=x --return_offset=250 --return_scale=7
# Data of three actions for a policy of two.
LC_ALL=C sed 's/an\x02/an\x03/' other.cbor >third.cbor
three='--data: expected the action space Discrete(2), as the policy has, received Discrete(3)'
refuses "$three" train --data=third.cbor --init=other/policy.safetensors --out=x
refuses "other/policy.safetensors: $three" quantize --policy=other/policy.safetensors --data=third.cbor --out=x
refuses "$three" compare --policy=other/policy.safetensors --data=third.cbor

"$spiketrain" train --data=data.cbor --init=whole/policy.safetensors --out=tuned --batch=4 --episodes=2 --no_baselines \
  --iterations=2 --target_rate=1 2>/dev/null >/dev/null
grep -aq 'lineage.*--out=whole' tuned/policy.safetensors || fail "lineage"
"$spiketrain" eval --policy=tuned/policy.safetensors --episodes=1 --seed=2000000 --json | grep -q '"first_seed": 2000000'

# Trains with several seeds: each is equal to a training with this seed alone, and the best one is kept.
"$spiketrain" train --data=data.cbor --out=seeds "${tiny[@]}" --iterations=2 --seeds=4,5 >seeds.txt 2>/dev/null
grep -qE '^2 seeds: mean return [0-9.]+, standard deviation [0-9.]+; best: [45]$' seeds.txt || fail "$(cat seeds.txt)"
best=$(sed -nE 's/^2 seeds: .*best: //p' seeds.txt)
cmp seeds/policy.safetensors "seeds/seed-$best/policy.safetensors"
other=$((9 - best))
return_of() { sed -nE "s/^seed $1: return ([0-9.]+),.*/\1/p" seeds.txt; }
awk "BEGIN { exit !($(return_of "$best") >= $(return_of "$other")) }" || fail "the best seed: $(cat seeds.txt)"
"$spiketrain" train --data=data.cbor --out=seed5 "${tiny[@]}" --iterations=2 --seed=5 --json 2>/dev/null >seed5.json
grep -q "\"mean_return\": $(return_of 5 | sed -E 's/\.?0+$//')" seed5.json || fail "seed 5: $(cat seeds.txt seed5.json)"
"$spiketrain" train --data=data.cbor --out=seeds "${tiny[@]}" --iterations=2 --seeds=4,5 --resume --json 2>/dev/null |
  grep -q "\"best_seed\": $best" || fail "--seeds with --resume"
# Nothing is replaced unasked, and what is there is refused before anything is recorded or trained. --resume does not
# replace the policy of another run either.
mkdir second
cp -r seeds/seed-5 second
refuses "--out: expected another directory, --resume to continue the run, or --overwrite to replace it, received one with \
second/seed-5/checkpoint.pt" train --out=second "${tiny[@]}" --iterations=2 --seeds=4,5
[[ ! -e second/seed-4 ]] || fail "seed 4 was trained before seed 5 was refused"
cp -r seed5 taken
rm taken/checkpoint.pt
for flag in --json --resume; do
  refuses "--out: expected another directory, or --overwrite to replace it, received one with taken/policy.safetensors" \
    train --data=data.cbor --out=taken "${tiny[@]}" --iterations=1 --seeds=4 "$flag"
done
cp seed5/checkpoint.pt taken
refuses "--out: expected another directory, --resume to continue the run, or --overwrite to replace it, received one with \
taken/checkpoint.pt" train --data=data.cbor --out=taken "${tiny[@]}" --iterations=1 --seeds=4 --resume
refuses "--overwrite: expected no such flag beside --resume" \
  train --data=data.cbor --out=taken "${tiny[@]}" --iterations=1 --seeds=4 --resume --overwrite
[[ ! -e taken/seed-4 && $(sha taken/policy.safetensors) == $(sha seed5/policy.safetensors) ]] || fail "a refused --seeds"
"$spiketrain" train --data=data.cbor --out=taken "${tiny[@]}" --iterations=1 --seeds=4 --overwrite >/dev/null 2>&1
cmp taken/policy.safetensors taken/seed-4/policy.safetensors
refuses '--seeds: expected different integers of at least 0, received 4' \
  train --data=data.cbor --out=x "${tiny[@]}" --seeds=4,4
refuses '--seed: expected no such flag beside --seeds, received 3' train --data=data.cbor --out=x --seeds=4 --seed=3
refuses '--seeds: expected an environment that spiketrain plays, received MyRobot1-v1; `python -m spikeserve imitate --seeds` plays those of Gymnasium' \
  train --data=other.cbor --out=x --seeds=1,2

# Attention that starts at a given timestep.
"$spiketrain" train --data=data.cbor --out=back "${tiny[@]}" --iterations=1 --lookback=4 >/dev/null 2>&1
refuses '--lookback: expected 1 to 4, below --context, received 5' \
  train --data=data.cbor --out=x "${tiny[@]}" --lookback=5
refuses '--lookback: expected --mode=pos or full with --phase_clock=timestep, received route with timestep' \
  train --data=data.cbor --out=x "${tiny[@]}" --mode=route --lookback=2
refuses '--lookback: expected no such flag beside --init, received 2' \
  train --data=data.cbor --out=x --init=whole/policy.safetensors --lookback=2
refuses '--mirror: expected 1 to 2, less than half of --context, received 3' \
  train --data=data.cbor --out=x "${tiny[@]}" --mirror=3
refuses '--mirror: expected no such flag beside --lookback' \
  train --data=data.cbor --out=x "${tiny[@]}" --lookback=4 --mirror=2
refuses '--mirror: expected no such flag beside --init, received 2' \
  train --data=data.cbor --out=x --init=whole/policy.safetensors --mirror=2

# The paper's other learners: a router of one layer, and a head that learns by three factors alone.
"$spiketrain" train --data=data.cbor --out=local "${tiny[@]}" --iterations=2 --routing_hidden_size=2 --gate=sigmoid \
  --activity_router --freeze=head --local_rate=0.01 --local_rule=hebbian >/dev/null 2>&1 || fail "local"
refuses '--activity_router: expected --routing_hidden_size=2, the number of heads, received 16' \
  train --data=data.cbor --out=x "${tiny[@]}" --activity_router
refuses '--activity_router: expected no such flag beside --init, but --freeze=routing.hidden' \
  train --data=data.cbor --out=x --init=whole/policy.safetensors --activity_router
{ "$spiketrain" train --data=data.cbor --out=x "${tiny[@]}" --freeze=heads 2>&1 || true; } |
  grep -q 'between dots: embed.*; received heads$' || fail "--freeze"

# Rounds a policy from end to end; equal starts give a small difference, and a policy is rounded once.
"$spiketrain" quantize --policy=whole/policy.safetensors --out=new/2/policy.safetensors --episodes=3 --seed=2000000 \
  --allow_loss --json |
  grep -q '"difference_95_percent"'
grep -aq "parent_sha256.*$(sha256sum <whole/policy.safetensors | cut -d' ' -f1)" new/2/policy.safetensors ||
  fail "the parent's hash"
grep -aq 'command.*spiketrain quantize --policy=whole/policy.safetensors .*--allow_loss.*lineage.*--out=whole' new/2/policy.safetensors ||
  fail "the command or the lineage of the integer policy"
"$spiketrain" eval --policy=new/2/policy.safetensors --episodes=1 --ablate=phase --json | grep -q '"phase"'
refuses 'new/2/policy.safetensors: arithmetic: expected float32, received integer' \
  quantize --policy=new/2/policy.safetensors --out=x
# Converts a policy in int8 that a release left, to float32 and to integers, which play alike.
int8=$releases/0.1.0/policies/cartpole-frugal/2/policy.safetensors
refuses "$int8: config.arithmetic: expected float32 or integer, received int8, which is no longer served: \`spiketrain quantize --policy=OLD \
--out=NEW\` converts the file to integers, and with --to=float32 to float32" \
  eval --policy="$int8" --episodes=1
"$spiketrain" quantize --policy="$int8" --out=float32/policy.safetensors --to=float32 --require=good >float32.txt
[[ $(cat float32.txt) == "verdict: good: nothing was rounded" ]] || fail "the verdict of float32: $(cat float32.txt)"
says float32/policy.safetensors "\\\"parent_sha256\\\":\\\"$(sha "$int8")\\\""
"$spiketrain" quantize --policy="$int8" --out=converted/policy.safetensors --episodes=5 --json >converted.json ||
  fail "the released policy in integers: $(cat converted.json)"
"$spiketrain" eval --policy=float32/policy.safetensors --episodes=5 --json | grep -q '"mean_return": 500.0' || fail "the returns of the converted policy"
refuses '--to=float32: expected a policy in int8, received one in float32' \
  quantize --policy=whole/policy.safetensors --out=x --to=float32
refuses '--out: expected the file to write, received none' quantize --policy=whole/policy.safetensors
refuses '--policy: expected a policy file, received none' quantize --out=x
refuses '--episodes: expected at least 1, received 0' quantize --policy=whole/policy.safetensors --out=x --episodes=0

# One episode is no reason to refuse integers, and none to call them good.
echo '{"before": [110], "after": [60], "random": [10]}' >once.json
once=(quantize --policy=whole/policy.safetensors --out=once.safetensors --returns=once.json)
"$spiketrain" "${once[@]}" >once.txt
cat >once.expected <<'EOF'
verdict: weak: the integers lost 50.00 % of the range of the return (one episode has no interval)
try: more episodes, because chance may explain any loss in one
EOF
cmp once.txt once.expected
refuses '--require: expected a verdict of good or better, received weak: the integers lost 50.00 % of the range of the return '\
'(one episode has no interval)' "${once[@]}" --require=good
"$spiketrain" eval --policy=whole/policy.safetensors --against=whole/policy.safetensors --episodes=1 >once.txt
grep -q 'difference 0.000 (one episode has no interval)$' once.txt || fail "$(cat once.txt)"

# Integers of a foreign environment are judged by --data, unless nothing depends on it.
foreign=(quantize --policy=other/policy.safetensors --data=other.cbor --out=foreign.safetensors --allow_loss)
"$spiketrain" "${foreign[@]}" | grep -q '^verdict: .* of the range of the agreement (' || fail "the agreement"
"$spiketrain" "${foreign[@]}" --max_loss=1 >foreign.txt
cat >foreign.expected <<'EOF'
verdict: weak: what the integers lost was not measured, because --max_loss=1 allows any loss
try: a --max_loss below 1, which measures the agreement with --data
EOF
cmp foreign.txt foreign.expected

# Leaves hidden neurons out. The record names the calibration set.
"$spiketrain" quantize --prune --policy=whole/policy.safetensors --data=data.cbor --out=new/3/policy.safetensors \
  --episodes=3 --allow_loss >/dev/null
says new/3/policy.safetensors '\"arithmetic\":\"integer\"'
says new/3/policy.safetensors '\"rounding_loss\":{\"measure\":\"return\",'
refuses '--max_loss: expected 0 to 1, received 2' quantize --policy=whole/policy.safetensors --out=x --max_loss=2
says new/3/policy.safetensors "\\\"data_sha256\\\":{\\\"data.cbor\\\":\\\"$(sha data.cbor)\\\"}"
for flag in --prune --returns=once.json; do
  refuses '--mode, --data, --prune, --returns: expected with --to=integer, received --to=float32' \
    quantize --to=float32 --policy=whole/policy.safetensors --out=x "$flag"
done
# A dense policy has no silent neurons.
"$spiketrain" train --data=data.cbor --out=dense "${tiny[@]}" --mode=dense --iterations=1 >/dev/null 2>&1
refuses 'dense/policy.safetensors: --prune: expected a mode with spikes, received dense' \
  quantize --to=integer --policy=dense/policy.safetensors --out=x --prune
refuses '--init: expected a policy in float32, received one in integer' \
  train --data=data.cbor --init=new/2/policy.safetensors --out=x

# Trains in integers, from nothing and from a float32 policy. The policy is an integer policy, and its record says so.
integers() { "$spiketrain" train --data=data.cbor --arithmetic=integer --batch=4 --episodes=2 --no_baselines "$@"; }
integers --out=integers "${tiny[@]}" --iterations=4 >integers.txt 2>/dev/null
grep -q '^shape: .*, arithmetic integer$' integers.txt || fail "the shape: $(cat integers.txt)"
says integers/policy.safetensors '\"arithmetic\":\"integer\"'
says integers/policy.safetensors ' --arithmetic=integer '
says integers/policy.safetensors '"dtype":"I8"'
cp -r integers integers2
rm integers2/policy.safetensors
integers --out=integers2 "${tiny[@]}" --iterations=4 --resume 2>/dev/null >integers2.txt
cmp <(grep -v '^policy:' integers.txt) <(grep -v '^policy:' integers2.txt)
refuses_to_continue integers '--arithmetic=integer, received none' --iterations=4
integers --out=tuned-integers --init=whole/policy.safetensors --iterations=2 --json 2>/dev/null |
  grep -q '"int_45nm"' || fail "the energy of an integer policy"
"$spiketrain" account --policy=tuned-integers/policy.safetensors --episodes=1 | grep -q '^int_sram_45nm ' ||
  fail "the account of an integer policy"
refuses '--policy: arithmetic: expected integer, received float32' account --policy=whole/policy.safetensors --episodes=1
says tuned-integers/policy.safetensors "\\\"parent_sha256\\\":\\\"$(sha whole/policy.safetensors)\\\""
grep -aq 'lineage.*--out=whole' tuned-integers/policy.safetensors || fail "lineage of integers"
# Integers that lost what --init returns are not written. The checkpoint is, so that the loss may be accepted.
lost() { integers --out=lost --init=float32/policy.safetensors --iterations=6 --warmup=1 --learning_rate=0.5 "$@"; }
if lost >/dev/null 2>message; then fail "accepted: integers that lost the return"; fi
grep -q '^spiketrain: --max_loss: expected a loss of at most 0.01 of the range of the return, received .* --overwrite, or accept' \
  message || fail "the refusal of a loss: $(cat message)"
[[ -e lost/checkpoint.pt && ! -e lost/policy.safetensors ]] || fail "what is left of integers that lost the return"
lost --resume --allow_loss 2>/dev/null | grep -q '^the integers lost .* of the range of the return' || fail "the loss"
says lost/policy.safetensors '\"rounding_loss\":{\"measure\":\"return\",'
refuses '--arithmetic=integer: expected a mode with spikes, received dense; `spiketrain quantize --to=integer` converts a trained '\
'dense policy' train --data=data.cbor --out=x "${tiny[@]}" --mode=dense --arithmetic=integer
refuses '--arithmetic: expected float32 or integer, received "int4"' train --data=data.cbor --out=x --arithmetic=int4

# Records episodes of a student, labelled by the expert.
"$spiketrain" dataset --steps=100 --expert_fraction=0 --student=whole/policy.safetensors --weigh --out=student-v0 |
  grep -q '"student_steps":'
"$spiketrain" eval --policy=tuned/policy.safetensors --episodes=2 --target_returns=50,500 --ablate=context,return |
  grep -q 'rank correlation 0.000'
refuses "--ablate: expected context, changes, attention, phase, routing or return, received 'head'" \
  eval --policy=tuned/policy.safetensors --ablate=head

refuses 'command: expected one of expert, dataset, train, quantize, eval, compare, neurobench, ope, account, received none'
refuses '--out: expected the directory to write into, received none' train
refuses '--heads: expected what --init has, 2, or no such flag, received 8' \
  train --data=data.cbor --init=whole/policy.safetensors --out=x --heads=8
refuses '--device: expected cpu, cuda or cuda:N, received gpu' train --data=data.cbor --out=x --device=gpu
refuses '--ticks: expected 1 to 256, received 0' train --data=data.cbor --init=whole/policy.safetensors --out=x --ticks=0
"$spiketrain" train --data=data.cbor --init=whole/policy.safetensors --out=fewer --ticks=1 --iterations=1 --batch=2 --episodes=1 \
  --no_baselines >/dev/null 2>&1 || fail "a policy cannot go on with fewer ticks"
grep -aq '"ticks":1[,}]' fewer/policy.safetensors || grep -aq 'ticks\\":1[,}]' fewer/policy.safetensors ||
  fail "fewer/policy.safetensors has not one tick"
# Norms that fade leave a policy without any, which trains on and becomes integers. Another policy with norms may fade, too.
fade() { "$spiketrain" train --data=data.cbor --batch=4 --episodes=2 --no_baselines "$@"; }
fade --norm=fade --out=faded "${tiny[@]}" --iterations=10 >faded.txt 2>/dev/null
grep -q '^shape: .*, no norms$' faded.txt || fail "the shape: $(cat faded.txt)"
says faded/policy.safetensors '\"norm\":\"none\"'
! grep -aq '\.norm\.' faded/policy.safetensors || fail "norms are left"
cp -r faded faded2
rm faded2/policy.safetensors
fade --norm=fade --out=faded2 "${tiny[@]}" --iterations=10 --resume >faded2.txt 2>/dev/null
cmp <(grep -v '^policy:' faded.txt) <(grep -v '^policy:' faded2.txt)
fade --init=faded/policy.safetensors --out=faded-on --iterations=2 >/dev/null 2>&1 || fail "no training without norms"
says faded-on/policy.safetensors '\"norm\":\"none\"'
fade --init=whole/policy.safetensors --norm=fade --out=faded-late --iterations=3 >/dev/null 2>&1 || fail "no late fading"
"$spiketrain" quantize --to=integer --policy=faded-on/policy.safetensors --out=faded-integer/policy.safetensors --episodes=2 \
  --allow_loss >/dev/null 2>&1 || fail "no integers without norms"
"$spiketrain" account --policy=faded-integer/policy.safetensors --episodes=1 >account.txt
grep -q '^limit ' account.txt || fail "no limits: $(cat account.txt)"
refuses '--norm: expected layer for a policy without norms, received fade' \
  train --data=data.cbor --init=faded/policy.safetensors --out=x --norm=fade
refuses '--norm: expected layer in mode dense, received fade' \
  train --data=data.cbor --out=x "${tiny[@]}" --mode=dense --norm=fade
refuses '--norm: expected layer with arithmetic integer, received fade' \
  train --data=data.cbor --out=x --arithmetic=integer --norm=fade
refuses '--arithmetic=integer: expected a policy with norms, received one without; `spiketrain quantize --to=integer` '\
'converts a trained one' train --data=data.cbor --init=faded/policy.safetensors --out=x --arithmetic=integer
refuses '--env: expected CartPole-v1 as in --data, received Acrobot-v1' train --data=data.cbor --env=Acrobot-v1 --out=x
refuses 'none.safetensors: no such file' eval --policy=none.safetensors
refuses '--steps: expected no such flag beside --data, received 5' train --data=data.cbor --out=x --steps=5
# What does not fit into memory is an error in one line, too.
if "$spiketrain" train --data=data.cbor --out=vast "${tiny[@]}" --iterations=1 --validation=0 --clip_steps=200000 2>message; then
  fail "clips of 200,000 steps"
fi
[[ $(tail -1 message) == "spiketrain: "*"allocate memory"* ]] || fail "too little memory: $(cat message)"
refuses '--data_memory: expected at least 1, received 0' train --data=data.cbor --out=x --data_memory=0
refuses '--batch: expected at least 1, received 0' train --data=data.cbor --out=x --batch=0
echo ok
