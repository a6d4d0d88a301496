"""What recorded torque says: gains, where a payload hangs, what hand the model lacks; and when it
is believed.
"""

from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, XML, commands, recordings, write_arm
from logs import arm_sequence, late, wave

from gaponet.base.errors import RobotError
from gaponet.data.signals import differentiate, lowpass
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot
from gaponet.sim.dynamics import CUTOFF_HZ, inverse_dynamics
from gaponet.sim.model import build_model, model_hash
from gaponet.sim.replay import replay
from gaponet.sysid.identify import identify
from gaponet.sysid.options import IdentifyOptions
from gaponet.sysid.steps.torque_fit import TorqueFit


def moved(robot, metres, hand):
    """The robot with its payload hung elsewhere, and a hand."""
    mounts = []
    for mount in robot.payload_mounts:
        x, y, z = mount.pos
        mounts.append(replace(mount, pos=(x + metres, y, z), mass=hand))
    return replace(robot, payload_mounts=tuple(mounts))


QUICK = IdentifyOptions(terms=(), table=False, joints_alone=True, nthread=1)
POST = """<body name="post" pos="0 1 0">
  <geom size="0.02" mass="0.1" contype="0" conaffinity="0"/>
</body>"""
FIRST_MOUNT = (
    '[[payload_mount]]\nside = "post"\nbody = "post"\npos = [0.2, 0.0, 0.0]\n'
    '[[payload_mount]]\nside = "hand"'
)


@pytest.mark.parametrize("second", [False, True])
def test_torque_determines_the_payloads_place_and_the_hands_mass_at_the_mount_that_a_joint_carries(
    tmp_path, second
):
    toml = TOML
    xml = XML
    if second:
        toml = toml.replace('[[payload_mount]]\nside = "hand"', FIRST_MOUNT)
        xml = xml.replace("<worldbody>", f"<worldbody>{POST}")
    robot = write_arm(tmp_path / "arm", toml, xml)
    true = moved(robot, -0.06, 0.1)
    windows = []
    for mass in (0.0, 0.2, 0.4):
        for s in recordings(robot, 2, rows=200):
            model = build_model(true, mass, "hand", s.dt)
            qpos = lowpass(s.qpos.astype(float), s.dt, CUTOFF_HZ)
            qvel = differentiate(qpos, s.dt)
            tau = inverse_dynamics(model, qpos, qvel, differentiate(qvel, s.dt))
            meta = replace(s.meta, payload_mass=mass, payload_side="hand")
            one = replace(s, tau=tau, meta=meta)
            windows += [one.rows(slice(start, start + 50)) for start in range(0, 200, 50)]
    found = TorqueFit(windows, robot).payload_placed().payload_mounts[-1]
    assert found.pos == pytest.approx(true.payload_mounts[-1].pos, abs=0.01)
    assert found.mass == pytest.approx(0.1, abs=0.02)


@pytest.fixture
def half_pd(arm):
    """Recordings whose torque is that of a PD servo in the first joint, and noise in the second."""
    rng = np.random.default_rng(0)
    made = []
    for seed in range(4):
        ctrl = wave(200, 2, hertz=0.5 + 0.1 * seed)
        s = arm_sequence(arm, ctrl, late(ctrl, 3), f"m{seed}")
        error = np.concatenate([np.zeros((1, 2)), s.ctrl[:-1] - s.qpos[1:]])
        tau = np.stack([7.0 * error[:, 0] - 0.3 * s.qvel[:, 0], rng.standard_normal(200)], axis=1)
        made.append(replace(s, tau=tau + 0.01 * rng.standard_normal(tau.shape)))
    return made


def test_gains_are_estimated_from_torque_of_a_pd_servo_and_from_no_other(arm, half_pd):
    (kp, _, kd, explained), (_, _, _, noise) = TorqueFit(half_pd, arm).gains().values()
    assert kp == pytest.approx(7.0, rel=0.03)
    assert kd == pytest.approx(0.3, rel=0.1)
    assert explained > 0.95 > 0.5 > noise


def test_the_robot_takes_the_gains_that_torque_explains_and_no_other(arm, half_pd):
    said = TorqueFit(half_pd, arm)
    assert set(said.known) == {arm.operated[0]}
    assert said.robot.servo.kp[0] == pytest.approx(7.0, rel=0.03)
    assert said.robot.servo.kp[1] == arm.servo.kp[1]


def test_recordings_without_torque_tell_no_gain(arm, half_pd):
    assert not TorqueFit([replace(s, tau=None) for s in half_pd], arm).known


def test_measurement_noise_does_not_lower_the_estimated_gains(arm):
    rng = np.random.default_rng(0)
    made = []
    for seed in range(12):
        ctrl = wave(120, 2, hertz=0.5 + 0.1 * seed)
        s = arm_sequence(arm, ctrl, late(ctrl, 4), f"m{seed}")
        error = np.concatenate([np.zeros((1, 2)), s.ctrl[:-1] - s.qpos[1:]])
        tau = 48.0 * error - 1.0 * s.qvel
        qpos = s.qpos + 0.01 * rng.standard_normal(s.qpos.shape)
        qvel = s.qvel + 0.3 * rng.standard_normal(s.qvel.shape)
        made.append(replace(s, tau=tau, qpos=qpos, qvel=qvel))
    for kp, _, kd, _ in TorqueFit(made, arm).gains().values():
        assert kp == pytest.approx(48.0, rel=0.03)
        assert kd == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize("rates", [[200] * 4, [500] * 4, [50, 500, 50, 500]])
def test_gains_of_a_servo_that_is_20_ms_late_are_found_at_every_rate(arm, rates):
    made = []
    for number, rate in enumerate(rates):
        dt = 1 / rate
        ctrl = wave(6 * rate, 2, dt=dt, hertz=0.5 + 0.1 * number)
        qpos = late(ctrl, round(0.06 * rate))
        qvel = np.gradient(qpos, dt, axis=0)
        tau = 80.0 * (late(ctrl, round(0.02 * rate)) - qpos) - 3.0 * qvel
        s = arm_sequence(arm, ctrl, qpos, f"m{number}", qvel=qvel, tau=tau)
        made.append(replace(s, dt=dt))
    for gains in TorqueFit(made, arm).gains().values():
        assert gains.kp == pytest.approx(80.0, rel=0.03)


def loaded(robot):
    """Six motions with three payloads each, of an arm with softer servos, a hand, and a payload
    hung elsewhere.
    """
    softer = {joint: {"kp": 12.0, "kd": 0.4} for joint in robot.operated}
    true = moved(robot, -0.06, 0.3).with_identified(softer)
    windows = []
    for motion in range(6):
        for mass in (0.0, 0.2, 0.4):
            ctrl = commands(60, motion)
            one = arm_sequence(robot, ctrl, ctrl, f"m{motion}")
            one = replace(one, meta=replace(one.meta, payload_mass=mass))
            (simulated,) = replay([one], true)
            answer = {field: getattr(simulated, field) for field in ("qpos", "qvel", "tau")}
            windows.append(replace(one, **answer))
    return windows


def test_the_fit_from_torque_is_used_if_validation_motions_accept_it(tmp_path):
    robot = write_arm(tmp_path / "arm")
    windows = loaded(robot)
    found = identify(windows[:12], robot, windows[12:], options=QUICK)
    (tried,) = found.comparisons
    assert found.chosen == tried.name == "torque"
    assert tried.accepted
    assert len(tried.before) == 6
    assert found.robot.servo.kp == pytest.approx([12.0, 12.0], rel=0.03)
    assert found.robot.payload_mounts[0].mass == pytest.approx(0.3, abs=0.05)
    # Fitted once more, to the motions that judged it.
    assert not np.array_equal(found.held_out[0].robot.servo.kp, found.robot.servo.kp)
    assert found.after == pytest.approx(tried.after.mean())
    assert tried.after.mean() < tried.before.mean()


def test_a_refit_with_the_validation_motions_is_dropped_if_it_follows_them_worse(
    tmp_path, monkeypatch
):
    robot = write_arm(tmp_path / "arm")
    own = TorqueFit.fit
    windows = loaded(robot)

    def astray(self, how):
        found = own(self, how)
        if len(self.sequences) == len(windows):
            return found.with_identified({"elbow": {"offset": 0.1}})
        return found

    monkeypatch.setattr(TorqueFit, "fit", astray)
    found = identify(windows[:12], robot, windows[12:], options=replace(QUICK, folds=1))
    assert found.chosen == "torque"
    assert found.held_out[0].robot is found.robot
    assert abs(found.robot.servo.offset).max() < 0.05


def test_identified_payload_mounts_are_stored_in_the_folder(tmp_path):
    robot = write_arm(tmp_path / "arm")
    true = replace(moved(robot, -0.06, 0.3), nominal=robot)
    save_robot(true, tmp_path / "kept")
    again = load_robot(tmp_path / "kept")
    assert again.payload_mounts == true.payload_mounts
    assert again.before_identification.payload_mounts == robot.payload_mounts
    assert model_hash(again) == model_hash(true) != model_hash(robot)


def test_an_identified_payload_mount_without_its_mount_is_refused(tmp_path):
    robot = write_arm(tmp_path / "arm")
    save_robot(replace(moved(robot, -0.06, 0.3), nominal=robot), tmp_path / "kept")
    file = tmp_path / "kept" / "robot.toml"
    text = file.read_text()
    file.write_text(text.replace('identified_mount."hand"', "identified_mount.foot"))
    with pytest.raises(RobotError, match="payload_mount"):
        load_robot(tmp_path / "kept")
