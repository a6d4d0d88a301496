#!/usr/bin/env bash
# The whole story, top to bottom: real SO-101 logs in, a simulator that moves like the robot and a report out; minutes on 2 cores.
#   examples/quickstart.sh LOGS OUT     LOGS: a SAGE folder, e.g. of isaac-sim2real/sage
set -euo pipefail
logs=$1 out=$2

# 1. Logs to a dataset. Timestamps, delays and offsets are found and recorded; nothing is applied in silence.
gaponet import "$logs" --robot so101 --unit-id lab --payload-mass 0 --out "$out/data"

# 2. Is the recording sound? Order, sign, unit, rate, saturation, lag, sag.
gaponet doctor "$out/data"

# 3. How far is the nominal simulator from the robot?
gaponet gap "$out/data"

# 4. Name the causes: a robot folder that moves like the robot, chosen on validation motions.
gaponet identify "$out/data" --out "$out/so101"

# 5. Before and after, by causes, on motions that nothing was fitted to; the recording's own repeatability is the floor.
gaponet eval "$out/so101" "$out/data"

# 6. Take it along: MJCF, what MuJoCo cannot hold beside it, and a check.py that runs without gaponet.
gaponet export "$out/so101" --to mjcf --out "$out/mjcf"

# 7. Does a network find anything more? The last line says so, also when it is nothing.
gaponet train "$out/data" --robot "$out/so101" --out "$out/gaponet" --budget 5m
gaponet eval "$out/gaponet" "$out/data"

# 8. One page to show to a colleague.
gaponet report "$out/gaponet"
