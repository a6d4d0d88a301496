"""How much recordings count as evidence, at one rate and at several."""

from dataclasses import replace

import numpy as np
import pytest
from arm import SERVO, commands, write_arm

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.sim.replay import replay
from gaponet.sysid.axes import Bounds
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD, SETTLE_S, JointRollouts
from gaponet.sysid.problem import JointFit

DURATION_S = 4.0


def fit_at(folder, rates):
    """The fit of an arm to a motion at each rate, Hz, and values (2,) with another offset."""
    robot = write_arm(folder)
    asked = []
    for number, rate in enumerate(rates):
        ctrl = commands(round(DURATION_S * rate), number, 1 / rate)
        meta = SequenceMeta(robot.name, "a", f"m{number}", 0.0, virtual=True)
        asked.append(Sequence(meta, robot.joint_names, 1 / rate, ctrl, ctrl, 0.0 * ctrl))
    moved = replay(asked, robot.with_identified(dict.fromkeys(robot.joint_names, SERVO)))
    parts = []
    for one, simulated in zip(asked, moved, strict=True):
        parts.append(replace(one, qpos=simulated.qpos, qvel=simulated.qvel))
    fit = JointFit(JointRollouts(parts, robot, nthread=1), robot, Bounds(robot, parts))
    values = {field: np.full(2, value) for field, value in (SERVO | {"offset": 0.02}).items()}
    return fit, values


@pytest.mark.parametrize("rates", [[50, 50], [200, 200], [200, 200, 200, 30]])
def test_rows_that_count_last_as_long_as_the_recordings(tmp_path, rates):
    fit, _ = fit_at(tmp_path, rates)
    expected = len(rates) * (DURATION_S - SETTLE_S)
    assert fit.rollouts.seconds == pytest.approx([expected] * 2, rel=0.01)


def test_the_correlation_time_is_the_same_at_one_rate_and_at_several(tmp_path):
    one, values = fit_at(tmp_path / "one", [200] * 4)
    several, _ = fit_at(tmp_path / "several", [200, 200, 200, 30])
    one.prior.update_correlation_time(one.rollouts, values)
    several.prior.update_correlation_time(several.rollouts, values)
    expected = one.prior.correlation_time
    assert expected.min() > 1.0
    assert several.prior.correlation_time == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("rates", [[50, 50], [200, 200], [200, 200, 200, 30]])
def test_the_prior_stands_against_one_measurement_in_each_correlation_time(tmp_path, rates):
    fit, _ = fit_at(tmp_path, rates)
    rows_of_one = np.square(fit.prior.error_std() * ERROR_SCALE_RAD / fit.prior.residual)
    expected = len(rates) * (DURATION_S - SETTLE_S) / fit.prior.correlation_time
    assert fit.rollouts.rows / rows_of_one == pytest.approx(expected, rel=0.01)
