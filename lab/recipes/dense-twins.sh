#!/usr/bin/env bash
# Trains a dense twin of each of six quiet policies: as large as version 3 of the policy, which is pruned, and on data of the
# same expert. Rounds it to integers, and prices both by the same rules.
#
# usage: lab/recipes/dense-twins.sh SPIKETRAIN OUT_DIR
#
# SPIKESERVE is the server that records the episodes of Gymnasium's tasks; default: spikeserve beside SPIKETRAIN. PYTHON is
# that of imitation.sh.
here=$(dirname "$0")
source "$here/imitation.sh"
source "$here/recipe.sh" # its function `integer` is that of spiketrain's own tasks
all=$out
python=${PYTHON:-python3}

# twin NAME ENVIRONMENT: begins the twin of a shipped policy in OUT_DIR/NAME, and sets `shape` to the flags for its sizes.
twin() {
  name=$1 environment=$2 out=$all/$1 policy=
  shipped=$("$python" "$here/../past_policies.py" "$name" 3)
  mkdir -p "$out"
  read -ra shape < <("$python" - "$shipped" <<'EOF'
import json, sys
with open(sys.argv[1], "rb") as file:
    header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
config = {"observation_changes": False} | json.loads(header["__metadata__"]["config"])
names = ("hidden_size", "heads", "layers", "context", "ffn_size", "observation_changes")
print(*(f"--{name}={json.dumps(config[name])}" for name in names))
EOF
  )
}

# play NAME DATA,... FLAGS...: a stage of a twin. Clips are whole windows: a dense policy learns an embedding of each timestep.
play() {
  stage "$1" "$2" --mode=dense "${shape[@]}" --batch=64 --clip_steps=20 --no_baselines --episodes=20 "${@:3}"
}

# account TWIN FLAGS...: prints what a decision of the shipped policy and of the twin costs.
account() {
  if [[ ! -f $out/account.txt ]]; then
    "$spiketrain" account --policy="$shipped" --dense="$1" "${@:2}" > "$out/account.partial"
    mv "$out/account.partial" "$out/account.txt"
  fi
  echo "$name"
  cat "$out/account.txt"
}

# finish STARTS FLAGS...: rounds the twin of a task that spiketrain has, and prints the returns and the costs of both from
# unseen starts. FLAGS are those of the calibration set: one that the twin played itself would take longer than its training.
finish() {
  data calibration --seed=9 --steps=10000 --expert_fraction=0 --disturbed_fraction=1 "${@:2}"
  if [[ ! -f $out/returns.txt ]]; then
    "$spiketrain" quantize --to=integer --policy="$policy" --data="$out/calibration.cbor" \
      --out="$out/integer/policy.safetensors" --episodes="$1" --seed=2000000 > "$out/returns.partial"
    mv "$out/returns.partial" "$out/returns.txt"
  fi
  cat "$out/returns.txt"
  "$spiketrain" eval --policy="$shipped" --episodes="$1" --seed=2000000
  account "$out/integer/policy.safetensors" --episodes="$1" --seed=2000000
}

# finish_imitation: the same for a twin of `imitate`, but with the costs of 20 episodes of the shipped policy that a server
# recorded.
finish_imitation() {
  "$python" "$here/integer_version.py" "$environment" --out="$out" --spiketrain="$spiketrain" --calibration=20
  if [[ ! -d $out/recordings ]]; then
    "$python" - "${SPIKESERVE:-$(dirname "$spiketrain")/spikeserve}" "${shipped%/"$name"/*}" "$environment" "$name" "$out/recordings" <<'EOF'
import pathlib, shutil, subprocess, sys
import spikeserve
server, policies, environment, name, recordings = sys.argv[1:]
partial = pathlib.Path(recordings + ".partial")
shutil.rmtree(partial, ignore_errors=True)
flags = [f"--policies={policies}", "--listen=127.0.0.1:0", "--http_listen=127.0.0.1:0", f"--record_dir={partial}"]
with subprocess.Popen([server, *flags], stdout=subprocess.PIPE, text=True) as process:
    try:
        address = process.stdout.readline().split()[-1]
        options = spikeserve.SessionOptions(record=True)
        print(spikeserve.evaluate(environment, name, server=address, episodes=20, seed=2_000_000, options=options))
    finally:
        process.terminate()
partial.rename(recordings)
EOF
  fi
  account "$out"/policies/*/3/policy.safetensors --recordings="$out/recordings"
}

twin lunar-lander-tick LunarLander-v3
imitate "$environment" --expert=experts:land --mode=dense --train-flags="${shape[*]}" --learning-rate=0.001 --iterations=2000 \
  --rounds=0 --selection-episodes=20 --episodes=100
finish_imitation

twin double-pendulum-tick InvertedDoublePendulum-v5
imitate "$environment" --expert=experts:balance_double_pendulum --mode=dense --train-flags="${shape[*]}" --learning-rate=0.001 \
  --action-noise=0 --longest-burst=1 --burst-rate=0.2 --iterations=2000 --rounds=1 --round-disturbed=0.5 \
  --round-iterations=1000 --selection-episodes=20 --episodes=20
finish_imitation

twin cartpole-tick CartPole-v1
data mixed --steps=50000 --expert_fraction=0.5 --disturbed_fraction=0.5
play 1-play mixed --seed=1 --iterations=400
finish 20 # 500 steps each

twin mountaincar-tick MountainCar-v0
data disturbed --steps=60000 --expert_fraction=0.1 --disturbed_fraction=0.9
play 1-play disturbed --seed=1 --iterations=500
finish 100

# Noise in the action tokens, as in pendulum-tick.sh.
twin pendulum-tick Pendulum-v1
data cautious --expert=cautious --steps=60000 --expert_fraction=0.1 --disturbed_fraction=0.9 --wide_start_fraction=0.25
play 1-play cautious --seed=1 --iterations=500 --action_noise=0.5
finish 100 --expert=cautious

# The expert's data alone lose more than ten steps, so the second stage also has the states that the twin itself reaches.
twin acrobot-frugal Acrobot-v1
data base --expert=lookahead --weigh --steps=40000 --expert_fraction=0.1 --disturbed_fraction=0.9
play 1-play base --seed=1 --iterations=500
data round1 --seed=1 --expert=lookahead --weigh --steps=40000 --expert_fraction=0 --student="$policy"
play 2-own base,round1 --seed=2 --iterations=600
finish 100 --expert=lookahead
