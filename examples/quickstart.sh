#!/usr/bin/env bash
# The whole story, top to bottom: real SO-101 logs in, an aligned simulator and a report out. About 15 minutes on 2 cores.
#   examples/quickstart.sh LOGS OUT     LOGS: a SAGE folder, e.g. of isaac-sim2real/sage
set -euo pipefail
logs=$1 out=$2

# 1. Logs to a dataset. Timestamps, delays and offsets are found and recorded; nothing is applied in silence.
gaponet import "$logs" --robot so101 --unit-id lab --payload-mass 0 --out "$out/data"

# 2. Is the recording sound? Order, sign, unit, rate, saturation, lag, sag.
gaponet doctor "$out/data"

# 3. How far is the nominal simulator from the robot?
gaponet gap "$out/data"

# 4. Train the operator and the baseline network; the split by motion is fixed by the motions' names.
gaponet train "$out/data" --out "$out/gaponet" --budget 10m
gaponet train "$out/data" --out "$out/mlp" --model mlp --budget 5m

# 5. Step the simulator with the shipped model against motions it never saw.
gaponet eval "$out/gaponet" "$out/data" --also "$out/mlp"

# 6. One page to show to a colleague.
gaponet report "$out/gaponet"
