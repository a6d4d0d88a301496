"""gymnasium environments on the aligned simulator."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from arm import commands, write_arm
from runs import small_model

from gaponet.base.errors import UsageError
from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.robot.folder import save_robot
from gaponet.sim.model import build_model

gymnasium = pytest.importorskip("gymnasium")


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def model(robot, tmp_path_factory):
    run = tmp_path_factory.mktemp("run")
    save_robot(robot, run / "robot")
    return small_model(robot, run / "model")


def test_the_tracking_environment_keeps_gymnasiums_rules(robot, model):
    from gymnasium.utils.env_checker import check_env

    from gaponet.deploy.gym import TrackingEnv

    check_env(
        TrackingEnv(AlignedSim(robot, model), [commands(30, 0), commands(40, 1)]),
        skip_render_check=True,
    )


def test_gymnasium_makes_it_by_name():
    how = {"robot": "so101", "motions": ["chirp-elbow_flex"], "preview": 1}
    env = gymnasium.make_vec(
        "gaponet.deploy.gym:gaponet/Tracking-v0", num_envs=2, vectorization_mode="sync", **how
    )
    observation, _ = env.reset(seed=0)
    assert observation.shape == env.observation_space.shape == (2, 15)
    assert (env.step(env.action_space.sample())[1] < 0).all()


def test_action_zero_follows_the_reference(robot, model):
    from gaponet.deploy.gym import TrackingEnv

    reference = commands(30, 0)
    env = TrackingEnv(AlignedSim(robot, model), [reference])
    sim = AlignedSim(robot, model)
    env.reset()
    sim.reset(reference[0])
    truncated = False
    t = 0
    while not truncated:
        t += 1
        _, reward, terminated, truncated, info = env.step(np.zeros(2))
        sim.step(reference[t])
        error = sim.qpos - reference[t]
        np.testing.assert_allclose(info["error"], error, atol=1e-9)
        assert reward == pytest.approx(-np.mean(error**2) / 0.01)
        assert not terminated
    assert t == 28


def test_motions_of_another_width_are_refused(robot, model):
    from gaponet.deploy.gym import TrackingEnv

    with pytest.raises(UsageError, match="motions"):
        TrackingEnv(AlignedSim(robot, model), [np.zeros((10, 3))])


@pytest.mark.parametrize(("stiffer", "atol"), [(1.0, 1e-6), (2.0, 5e-3)])
def test_a_wrapped_environment_moves_as_the_aligned_simulator(robot, model, stiffer, atol):
    from gaponet.deploy.gym import AlignedActions

    class Plain(gymnasium.Env):
        """A MuJoCo environment as users write them."""

        model = build_model(robot.with_servo(kp=stiffer * robot.servo.kp))
        dt = 0.02
        data = mujoco.MjData(model)
        action_space = observation_space = gymnasium.spaces.Box(-2, 2, (2,))
        spec = SimpleNamespace(id="plain")

        def reset(self, *, seed=None, options=None):
            mujoco.mj_resetData(self.model, self.data)
            return self.data.qpos.copy(), {}

        def step(self, action):
            self.data.ctrl[:] = action
            mujoco.mj_step(self.model, self.data, robot.decimation)
            return self.data.qpos.copy(), 0.0, False, False, {}

    env = AlignedActions(Plain(), model, payload_mass=0.0)
    sim = AlignedSim(robot, model)
    for _ in range(2):
        env.reset()
        sim.reset()
        for target in commands(20, 2):
            observation = env.step(target)[0]
            sim.step(target)
        np.testing.assert_allclose(observation, sim.qpos, atol=atol)
    assert (env.align.transfer is not None) == (stiffer > 1.0)
