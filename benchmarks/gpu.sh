#!/bin/sh
# Speed of gaponet on a GPU, without a network, in about ten minutes. Install gaponet[warp] and a CUDA build of torch before.
#     benchmarks/gpu.sh OUT
# Measures control steps per second beside bare mujoco_warp. Then trains once on the CPU and once on the GPU, which gets
# ten times the steps, and evaluates both on test motions. STEPS=90s DEVICE_STEPS=90s gives both the same time. Results:
# OUT/speed.txt, OUT/reached.txt, OUT/eval.txt. The same command resumes after an interrupt.
# Test without a GPU: DEVICE=warp-cpu SIZES="8 16" SECONDS_EACH=1 STEPS=10500 DEVICE_STEPS=10500 ENVS=8.
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
    $PYTHON -m gaponet train "$OUT/data" --out "$OUT/$1" --device "$1" --budget "$2" --model gaponet $resume \
        --pretraining.num-envs "$ENVS" --ppo.num-envs "$ENVS"
}
train cpu "$STEPS"
train "$DEVICE" "$DEVICE_STEPS"
$PYTHON "$HERE/gpu.py" --reached "$OUT/cpu" "$OUT/$DEVICE" | tee "$OUT/reached.txt"
for device in "$DEVICE" cpu; do $PYTHON -m gaponet eval "$OUT/$device" "$OUT/data"; done | tee "$OUT/eval.txt"
