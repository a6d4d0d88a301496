"""One name and one colour per method, in every figure and every scene."""

NAMES = {
    "target": "target",
    "recorded": "recorded",
    "nominal": "nominal simulator",
    "delay_offset": "delay + offset",
    "identified": "identified simulator",
    "inverse": "inverse labels",
    "mlp": "MLP",
    "transformer": "Transformer",
    "fno": "FNO",
    "gaponet": "GAPONet",
    "calibrated": "calibrated to the unit",
}
COLOURS = {
    "target": "#00838f",
    "recorded": "#111111",
    "nominal": "#8c8c8c",
    "delay_offset": "#d99000",
    "identified": "#2a9d6f",
    "inverse": "#12465b",
    "mlp": "#3b7dd8",
    "transformer": "#56c1e8",
    "fno": "#ded06a",
    "gaponet": "#c8102e",
    "calibrated": "#6a1b9a",
}
