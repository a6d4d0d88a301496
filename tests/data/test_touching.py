"""The doctor names motions that press on something."""

from dataclasses import replace

import numpy as np
from arm import recordings, write_arm

from gaponet.data.checks.touching import Standing, touching


def stands(tmp_path, blocked):
    """Postures held for a second each, low ones further from the command than gravity pulls if blocked."""
    robot = write_arm(tmp_path / "arm")
    first = recordings(robot, 1, rows=600)[0]
    down = np.repeat(np.linspace(-0.5, 0.5, 12), 50)
    load = 0.3 * np.cos(down)
    error = load / 20 + np.random.default_rng(0).normal(0, 1e-3, 600)
    pressing = (down > 0.4) if blocked else np.zeros(600, bool)
    error = error + 0.05 * pressing
    qpos = np.stack([down, 0 * down], axis=1).astype(np.float32)
    ctrl = qpos + np.stack([error, 0 * error], axis=1).astype(np.float32)
    tau = np.stack([20 * error, 0 * error], axis=1).astype(np.float32)
    sequence = replace(first, qpos=qpos, qvel=np.zeros_like(qpos), ctrl=ctrl, tau=tau)
    gravity = lambda q, mass, side: np.stack([0.3 * np.cos(q[:, 0]), np.zeros(len(q))], axis=1)  # noqa: E731
    return Standing.of(sequence, robot, lambda qpos: -0.2 * np.sin(qpos[:, 0]), gravity)


def test_a_motion_that_presses_is_named(tmp_path):
    stood = [stands(tmp_path, True)]
    found = list(touching(stood, lambda: stood))
    assert [f.level for f in found] == ["note"]
    assert "press a tip on something about -0.08 m high" in found[0].message


def test_gravity_s_sag_alone_is_no_contact(tmp_path):
    stood = [stands(tmp_path, False)]
    assert [f.level for f in touching(stood, lambda: stood)] == ["ok"]
    assert list(touching([], list)) == []
