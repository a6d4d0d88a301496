"""Servos of one type: one law for all of them, and how far it is from what others published.

The same motor has the same gain, damping, friction and armature in every joint. What is mounting stays a joint's own:
zero offset, delay, and friction by load, which depends on how the joint is borne.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.joint_rollouts import SOFT, JointRollouts
from gaponet.sysid.least_squares import descend, soft

Values = dict[str, Array]  # field → (n,) of the operated joints

OWN = ("offset", "delay", "friction_motor", "friction_external", "encoder_step")
SCALE = {"offset": 0.01, "delay": 0.005, "friction_motor": 0.05, "friction_external": 0.05}  # a large change
PART = 0.3  # of what is shared: a large change of its logarithm
FAR = 2.5  # in logarithms: bounds around the start
MOST = {"offset": 0.2, "delay": 0.1, "friction_motor": 0.8, "friction_external": 0.8}  # away from the joint's own
LOADED = 0.2  # friction by the motor's torque, in a second search
HEAVY = 2e-3  # price of an armature e times the one thought of, per row in SOFT's square
LEAST = 1e-6  # of kp: in place of a friction of zero
ITERATIONS = 25
ODD = 10.0  # times a published value, or a tenth of it


def same_servos(robot: RobotSpec) -> dict[str, list[int]]:
    """Type of servo → places among the operated joints, where robot.toml names one for two joints or more."""
    found: dict[str, list[int]] = {}
    for place, joint in enumerate(robot.operated_index):
        if (servo := robot.servos[joint]) is not None:
            found.setdefault(servo.name, []).append(place)
    return {name: places for name, places in found.items() if len(places) > 1}


def far_from_published(robot: RobotSpec) -> list[str]:
    """Values an order of magnitude off those published for a joint's servo, in words."""
    found = []
    for i in robot.operated_index:
        servo = robot.servos[i]
        for f, usual in servo.published.items() if servo else ():
            value = float(getattr(robot, f)[i])
            if servo and np.isfinite(value) and not usual / ODD < value < usual * ODD:
                told = f"published for the {servo.name} ({servo.source})"
                found.append(
                    f"{robot.joint_names[i]}: {f} {value:.3g} is {value / usual:.2g} times the {usual:.3g} {told}"
                )
    return found


def share(
    runs: JointRollouts, values: Values, places: list[int], armature: float, tell: Callable[[float], None]
) -> Values:
    """Fit one law to the joints at `places`; other joints stay as they are.

    Least squares, from the law of the joint that does best for all of them or from the middle of theirs, twice: with
    friction by load as it is, and with some for every joint, which can stand for friction of its own.

    Args:
        runs: Windows of recordings.
        values: What every joint's own fit found.
        places: Among the operated joints.
        armature: The one that is thought of, kg·m²: delay and damping can stand for much of it.
        tell: Called with the error of each iteration, a root mean square in rad.
    """
    # Without friction by load the joints that carry the others would need a friction of their own.
    values = {f: np.zeros_like(values["kp"]) for f in OWN if f.startswith("friction")} | values
    m, kp = len(places), values["kp"][places]
    # Over kp, because what a motion shows is a torque over it: what grows together lies on one axis then.
    over = {f: float(f not in ("kp", "stribeck_speed")) for f in values if f not in OWN}
    own = [f for f in SCALE if f in values]
    laws = np.array([np.log(np.maximum(values[f][places], LEAST * kp) / kp**r) for f, r in over.items()]).T / PART
    laws = np.concatenate([laws, np.median(laws, axis=0, keepdims=True)])
    mounting = np.concatenate([values[f][places] / SCALE[f] for f in own])
    loaded = mounting.copy()
    loaded[own.index("friction_motor") * m :][:m] = LOADED / SCALE["friction_motor"]
    starts = [np.concatenate([laws, np.tile(x, (m + 1, 1))], axis=1) for x in (mounting, loaded)]
    wide = np.concatenate([np.full(laws.shape[1], FAR / PART), *(np.full(m, MOST[f] / SCALE[f]) for f in own)])
    least = np.concatenate(
        [np.full(laws.shape[1], -np.inf), *(np.full(m, -np.inf if f == "offset" else 0) for f in own)]
    )

    def spread(x: Array) -> Values:
        """Candidates (k, P) → values (k, n)."""
        found = {f: np.tile(v, (len(x), 1)) for f, v in values.items()}
        shared = dict(zip(over, np.exp(x[:, : len(over)] * PART).T, strict=True))
        for f, r in over.items():
            found[f][:, places] = (shared[f] * shared["kp"] ** r)[:, None]
        for f, part in zip(own, np.split(x[:, len(over) :], len(own), axis=1), strict=True):
            found[f][:, places] = part * SCALE[f]
        return found

    def errors(xs: Array) -> Array:
        """(k, 1, P) → (k, 1, rows) in SOFT, and the price of an armature other than thought."""
        found = spread(xs[:, 0])
        rows = runs.errors(found)[:, places].reshape(len(xs), -1) / np.float32(SOFT)
        far = np.sqrt(2 * HEAVY * m * runs.rows.max()) * np.log(found["armature"][:, places[:1]] / armature)
        return np.concatenate([rows, far], axis=1, dtype=np.float32)[:, None]

    first = np.stack([x[soft(errors(x[:, None])).argmin()] for x in starts])[:, None]
    low, high = np.maximum(first.min(axis=0) - wide, least), first.max(axis=0) + wide
    scale = m * max(int(runs.rows.max()), 1)
    x, cost = descend(
        first, low, high, errors, ITERATIONS, lambda cost: tell(SOFT * float(np.sqrt(2 * cost.min() / scale)))
    )
    return {f: v[0] for f, v in spread(x[cost[:, 0].argmin()]).items()}
