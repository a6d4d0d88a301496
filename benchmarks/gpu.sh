#!/bin/sh
# What a GPU makes of gaponet, meant for ten minutes (never timed on one), and without a network (pip install "gaponet[warp,robots]" and a CUDA
# build of torch are there already):
#     benchmarks/gpu.sh OUT
# Steps a second beside bare mujoco_warp, then one training on the GPU and the same on the CPU, both measured by
# gaponet eval. Send OUT/speed.txt and OUT/eval.txt. Dry, without a GPU: DEVICE=warp-cpu SIZES="8 16" STEPS=2000 ENVS=8.
set -eu
OUT=${1:?give a folder for the results}
DEVICE=${DEVICE:-cuda} SIZES=${SIZES:-"1024 4096 16384"} STEPS=${STEPS:-2000000} ENVS=${ENVS:-4096} SECONDS_EACH=${SECONDS_EACH:-5}
HERE=$(dirname "$0") PYTHON=${PYTHON:-python}
mkdir -p "$OUT"
{ nvidia-smi -L 2>/dev/null || echo "no nvidia-smi"; $PYTHON "$HERE/gpu.py" --device "$DEVICE" --seconds "$SECONDS_EACH" $SIZES; } | tee "$OUT/speed.txt"
gaponet collect --robot so101 --fleet easy --recipe arm --out "$OUT/data"
for device in "$DEVICE" cpu; do
    [ -f "$OUT/$device/model/card.json" ] || gaponet train "$OUT/data" --out "$OUT/$device" --device "$device" --budget "$STEPS" \
        --warm-start.num-envs "$ENVS" --ppo.num-envs "$ENVS"
done
gaponet eval "$OUT/$DEVICE" "$OUT/data" --also "$OUT/cpu" | tee "$OUT/eval.txt"
