#!/bin/sh
# What a GPU makes of gaponet, meant for ten minutes (never timed on one), and without a network: pip install
# "gaponet[warp,robots]" and a CUDA build of torch are there already.
#     benchmarks/gpu.sh OUT
# Steps a second beside bare mujoco_warp; then one training on the CPU and one on the GPU, each with simulations of its
# own number, the GPU's with ten times the steps; when the GPU had reached the CPU's best on validation; both on motions
# that they never saw. Send OUT/speed.txt, OUT/reached.txt and OUT/eval.txt. Called again it goes on where it stopped.
# Dry, without a GPU: DEVICE=warp-cpu SIZES="8 16" SECONDS_EACH=1 STEPS=10500 DEVICE_STEPS=10500 ENVS=8.
set -eu
OUT=${1:?give a folder for the results}
DEVICE=${DEVICE:-cuda} SIZES=${SIZES:-"1024 4096 16384"} SECONDS_EACH=${SECONDS_EACH:-5}
STEPS=${STEPS:-2000000} ENVS=${ENVS:-0}
DEVICE_STEPS=${DEVICE_STEPS:-$((10 * STEPS))}
HERE=$(dirname "$0") PYTHON=${PYTHON:-python}
mkdir -p "$OUT"
{
    nvidia-smi -L 2>/dev/null || echo "no nvidia-smi"
    $PYTHON "$HERE/gpu.py" --device "$DEVICE" --seconds "$SECONDS_EACH" $SIZES
} | tee "$OUT/speed.txt"
[ -d "$OUT/cpu" ] || $PYTHON -m gaponet collect --robot so101 --fleet easy --recipe arm --out "$OUT/data"
train() {
    [ ! -f "$OUT/$1/model/card.json" ] || return 0
    [ -f "$OUT/$1/checkpoint.pt" ] && resume=--resume || resume=
    $PYTHON -m gaponet train "$OUT/data" --out "$OUT/$1" --device "$1" --budget "$2" $resume \
        --pretraining.num-envs "$ENVS" --ppo.num-envs "$ENVS"
}
train cpu "$STEPS"
train "$DEVICE" "$DEVICE_STEPS"
$PYTHON "$HERE/gpu.py" --reached "$OUT/cpu" "$OUT/$DEVICE" | tee "$OUT/reached.txt"
for device in "$DEVICE" cpu; do $PYTHON -m gaponet eval "$OUT/$device" "$OUT/data"; done | tee "$OUT/eval.txt"
