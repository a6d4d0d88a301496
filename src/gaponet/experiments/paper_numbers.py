"""Numbers printed in the GAPONet / SimLifter paper, for tables that compare with them. The paper's robots are real."""

from __future__ import annotations

from dataclasses import dataclass

PAYLOADS = (0.0, 1.0, 2.0, 3.0)  # kg per hand
# Counts of its dataset.
CARD = {
    "hours": 28.46,
    "sequences": 11_198,
    "frames": 257_493,
    "units": 4,
    "joints": 10,
    "repetitions": 3,
    "signals": 6,
}
# Its claims: reduction of the error, %.
CLAIMS = {"Q_dis, all payloads": 40, "Q_dis, heaviest payload": 50, "X": 40, "Y": 40, "Z": 70}


@dataclass(frozen=True)
class Printed:
    """A row of Table 2: number of observed values, and MPJAE in rad by payload."""

    obs_dim: int
    mpjae: tuple[float, float, float, float]


# The paper's own setting, without payload input, is a row of five comparisons.
OWN = Printed(140, (0.013, 0.012, 0.013, 0.015))
# Comparison → (setting, change in the syntax of experiments/variant.py, printed row).
TABLE_2: dict[str, tuple[tuple[str, str, Printed | None], ...]] = {
    "payload input": (
        ("in", "payload_input=on", Printed(141, (0.016, 0.017, 0.018, 0.019))),
        ("in, predictor alone", "payload_input=on:payload_trunk=off", None),
        ("out", "", OWN),
    ),
    "control rate": (("50 Hz", "", OWN), ("100 Hz", "rates=100", Printed(140, (0.019, 0.019, 0.023, 0.021)))),
    "history H": (
        ("2", "history=2", Printed(80, (0.016, 0.016, 0.017, 0.019))),
        ("4", "", OWN),
        ("6", "history=6", Printed(200, (0.015, 0.016, 0.016, 0.019))),
        ("8", "history=8", Printed(260, (0.017, 0.017, 0.018, 0.021))),
    ),
    "action duration": (
        ("1 period", "", OWN),
        ("3 periods, correction held", "delta_hold=3", Printed(140, (0.017, 0.016, 0.017, 0.018))),
        ("5 periods, correction held", "delta_hold=5", Printed(140, (0.015, 0.016, 0.017, 0.019))),
        ("3 periods, sensors held", "sensor_hold=3", Printed(140, (0.017, 0.016, 0.017, 0.018))),
        ("5 periods, sensors held", "sensor_hold=5", Printed(140, (0.015, 0.016, 0.017, 0.019))),
    ),
    "sensor value": (
        ("S(t+1) − S(t)", "", OWN),
        ("S(t+1)", "sensor_target=absolute", Printed(140, (0.016, 0.017, 0.018, 0.020))),
    ),
}

# Table 1: kg → mean |offset| along X, Y, Z, cm, of GAPONet, an MLP and the simulator's output sent as it is.
TABLE_1 = {
    0.0: ((0.3564, 0.6274, 0.4797), (0.4298, 0.6097, 1.7068), (0.6733, 0.6450, 1.9698)),
    1.0: ((0.3506, 0.7331, 0.4885), (0.4581, 0.5801, 1.7142), (0.5424, 0.7554, 1.9978)),
    2.0: ((0.3725, 0.7357, 0.5759), (0.4363, 0.7374, 1.8323), (0.8149, 1.2051, 2.1376)),
    3.0: ((0.4597, 0.7855, 0.6214), (0.4726, 0.7113, 2.1137), (1.1455, 1.2520, 1.9269)),
}
TABLE_1_METHODS = {"paper": 0, "gaponet": 0, "mlp": 1, "raw": 2}  # our method → column of TABLE_1
