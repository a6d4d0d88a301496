"""Numbers that the paper "SimLifter and GAPONet" prints, to stand beside ours.

Its robots are real.
"""

from __future__ import annotations

from dataclasses import dataclass

AXES = ("X", "Y", "Z")  # forward, left, up

# Claims of the text: reduction of an error, %.
CLAIM_ALL_PAYLOADS = 40
CLAIM_HEAVIEST_PAYLOAD = 50
CLAIM_BY_AXIS = {"X": 40, "Y": 40, "Z": 70}

# Table 1: payload, kg → mean |offset| of a hand along X, Y and Z, cm.
TABLE_1 = {
    "GAPONet": {
        0.0: (0.3564, 0.6274, 0.4797),
        1.0: (0.3506, 0.7331, 0.4885),
        2.0: (0.3725, 0.7357, 0.5759),
        3.0: (0.4597, 0.7855, 0.6214),
    },
    "MLP": {
        0.0: (0.4298, 0.6097, 1.7068),
        1.0: (0.4581, 0.5801, 1.7142),
        2.0: (0.4363, 0.7374, 1.8323),
        3.0: (0.4726, 0.7113, 2.1137),
    },
    "simulator's output": {
        0.0: (0.6733, 0.6450, 1.9698),
        1.0: (0.5424, 0.7554, 1.9978),
        2.0: (0.8149, 1.2051, 2.1376),
        3.0: (1.1455, 1.2520, 1.9269),
    },
}


@dataclass(frozen=True)
class PrintedRow:
    """A row of Table 2.

    Attributes:
        obs_dim: Number of observed values.
        mpjae: Mean absolute joint position error with 0, 1, 2 and 3 kg, rad.
    """

    obs_dim: int
    mpjae: tuple[float, float, float, float]


OWN_ROW = PrintedRow(140, (0.013, 0.012, 0.013, 0.015))  # "ours" in all five comparisons
TABLE_2 = {
    "payload in": PrintedRow(141, (0.016, 0.017, 0.018, 0.019)),
    "payload out": OWN_ROW,
    "100 Hz": PrintedRow(140, (0.019, 0.019, 0.023, 0.021)),
    "50 Hz": OWN_ROW,
    "history 2": PrintedRow(80, (0.016, 0.016, 0.017, 0.019)),
    "history 4": OWN_ROW,
    "history 6": PrintedRow(200, (0.015, 0.016, 0.016, 0.019)),
    "history 8": PrintedRow(260, (0.017, 0.017, 0.018, 0.021)),
    "action duration 1": OWN_ROW,
    "action duration 3": PrintedRow(140, (0.017, 0.016, 0.017, 0.018)),
    "action duration 5": PrintedRow(140, (0.015, 0.016, 0.017, 0.019)),
    "predict S(t+1)": PrintedRow(140, (0.016, 0.017, 0.018, 0.020)),
    "predict S(t+1) − S(t)": OWN_ROW,
}
