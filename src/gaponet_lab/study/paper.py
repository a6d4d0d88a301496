"""What the paper reports, to stand beside what we measure: the GAPONet / SimLifter paper, Tables 1 and 2.

Its robots are real, its unit of Table 2 is rad, of Table 1 cm; payloads are 0, 1, 2, 3 kg.
"""

from __future__ import annotations

from dataclasses import dataclass

PAYLOADS = (0.0, 1.0, 2.0, 3.0)  # kg


@dataclass(frozen=True)
class Printed:
    """A row of Table 2."""

    obs_dim: int
    mpjae: tuple[float, float, float, float]
    """rad, by payload."""

    @property
    def mean(self) -> float:
        """Over payloads, rad."""
        return sum(self.mpjae) / len(self.mpjae)


OURS = Printed(140, (0.013, 0.012, 0.013, 0.015))  # the row that the paper calls its own, in four of its comparisons
# Change of a setting, as study.variant reads it → its row.
TABLE_2 = {
    "payload_input=on": Printed(141, (0.016, 0.017, 0.018, 0.019)),
    "payload_input=off": OURS,
    "rates=50": OURS,
    "rates=100": Printed(140, (0.019, 0.019, 0.023, 0.021)),
    "history=2": Printed(80, (0.016, 0.016, 0.017, 0.019)),
    "history=4": OURS,
    "history=6": Printed(200, (0.015, 0.016, 0.016, 0.019)),
    "history=8": Printed(260, (0.017, 0.017, 0.018, 0.021)),
    "delta_hold=1": OURS,
    "delta_hold=3": Printed(140, (0.017, 0.016, 0.017, 0.018)),
    "delta_hold=5": Printed(140, (0.015, 0.016, 0.017, 0.019)),
    "sensor_target=delta": OURS,
    "sensor_target=absolute": Printed(140, (0.016, 0.017, 0.018, 0.020)),
}

# Table 1: kg → mean |offset| along X, Y, Z, cm, of GAPONet, an MLP and the simulator's output sent as it is.
TABLE_1 = {
    0.0: ((0.3564, 0.6274, 0.4797), (0.4298, 0.6097, 1.7068), (0.6733, 0.6450, 1.9698)),
    1.0: ((0.3506, 0.7331, 0.4885), (0.4581, 0.5801, 1.7142), (0.5424, 0.7554, 1.9978)),
    2.0: ((0.3725, 0.7357, 0.5759), (0.4363, 0.7374, 1.8323), (0.8149, 1.2051, 2.1376)),
    3.0: ((0.4597, 0.7855, 0.6214), (0.4726, 0.7113, 2.1137), (1.1455, 1.2520, 1.9269)),
}
TABLE_1_METHODS = ("gaponet", "mlp", "raw")
