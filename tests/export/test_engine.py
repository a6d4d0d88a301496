"""What other simulators are given: the network in torch, the simulator's numbers, an MJCF, an
action term.
"""

import re
import sys
from dataclasses import dataclass
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from arm import write_arm
from runs import random_run

from gaponet.base.errors import ModelError
from gaponet.cli.main import main
from gaponet.export.export_folder import export_model, export_robot
from gaponet.export.shipped import gaponet_action
from gaponet.export.shipped.gaponet_action import (
    AlignedAction,
    Aligner,
    DelayedAction,
    hold_friction,
    isaaclab_actuators,
    read_facts,
)
from gaponet.export.shipped.mjlab_servos import WorldServos, servo_addresses
from gaponet.export.shipped.scene_facts import require_scene
from gaponet.export.simulator_facts import mjcf_text, simulator_facts
from gaponet.export.torch_program import delta_step, program
from gaponet.nn.config import ModelConfig
from gaponet.robot.fingerprint import model_fingerprint
from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.robot.spec import load_robot
from gaponet.sim.model import build_model, model_hash
from gaponet.sim.servo import friction_limit, servo_torque

LATE = {
    "shoulder": {"delay": 0.007, "offset": 0.02, "zero": 0.01},
    "elbow": {"delay": 0.013, "stop_low": -1.2},
}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A run in a simulator with late servos, and its export."""
    folder = tmp_path_factory.mktemp("engine")
    robot = write_arm(folder / "arm").with_identified(LATE)
    model = random_run(folder / "run", robot)
    assert export_model(model, folder / "run", folder / "torch", payload_mass=0.1) <= 1e-5
    return folder


@pytest.fixture(scope="module")
def model(place):
    return random_run(place / "run", write_arm(place / "arm").with_identified(LATE))


def drawn(num_envs, columns=2, seed=0):
    rng = np.random.default_rng(seed)
    return [torch.from_numpy(rng.uniform(-0.5, 0.5, (num_envs, columns))).float() for _ in range(3)]


def test_an_aligner_follows_the_loop_over_any_number_of_worlds_with_some_beginning_anew(
    place, model
):
    for num_envs in (1, 5):
        aligner = Aligner(place / "torch", ["shoulder", "elbow"], num_envs, "cpu")
        loop = model.loop(num_envs)
        for t in range(8):
            if t == 4:
                ids = np.arange(0, num_envs, 2)
                loop.reset(ids)
                aligner.past.reset(torch.from_numpy(ids))
            q, v, a = drawn(num_envs, seed=t)
            loop.delta(*(x.numpy() for x in (q, v, a)), np.full(num_envs, 0.1, np.float32))
            np.testing.assert_allclose(aligner(q, v, a).numpy(), loop.applied, atol=1e-6)
        assert np.abs(loop.applied - a.numpy()).max() > 0.01


def test_joints_are_taken_by_name_others_are_left_alone_and_all_stay_within_their_limits(place):
    mine = Aligner(place / "torch", ["shoulder", "elbow"], 3, "cpu")
    scene = Aligner(place / "torch", ["elbow", "head", "shoulder"], 3, "cpu")
    q, v, a = (torch.cat([x, torch.full((3, 1), 9.0)], 1) for x in drawn(3))
    out = scene(*(x[:, [1, 2, 0]] for x in (q, v, a)))
    torch.testing.assert_close(out[:, [2, 0]], mine(*(x[:, :2] for x in (q, v, a))))
    assert (out[:, 1] == 9.0).all()
    assert scene(q, v, torch.full((3, 3), -3.0))[:, [0, 2]].min() >= -1.5
    with pytest.raises(ValueError, match="shoulder"):
        Aligner(place / "torch", ["elbow"], 3, "cpu")


def test_nothing_of_the_program_stays_on_the_device_that_it_was_written_on(place):
    aligner = Aligner(place / "torch", ["shoulder", "elbow"], 4, "meta")
    assert aligner(*(x.to("meta") for x in drawn(4))).device.type == "meta"


def test_a_past_made_in_inference_mode_is_begun_anew_outside_it(place):
    aligner = Aligner(place / "torch", ["shoulder", "elbow"], 3, "cpu")
    state = drawn(3)
    with torch.inference_mode():
        first = aligner(*state).clone()
        aligner(*drawn(3, seed=1))
    aligner.past.reset(torch.tensor([0, 2]))
    now = aligner(*state)
    torch.testing.assert_close(now[[0, 2]], first[[0, 2]])
    assert not torch.equal(now[1], first[1])


NO_NUMBER = [(float("nan"), 0), (float("inf"), 2)]


@pytest.mark.parametrize(("bad", "when"), NO_NUMBER)
def test_one_target_that_is_no_number_touches_one_world_and_no_later_period(place, bad, when):
    """The last sent target is repeated; in the first period, the position."""
    spoilt = Aligner(place / "torch", ["shoulder", "elbow"], 3, "cpu")
    held = Aligner(place / "torch", ["shoulder", "elbow"], 3, "cpu")
    for t in range(6):
        q, v, a = drawn(3, seed=t)
        spoilt_target = a.clone()
        held_target = a.clone()
        if t == when:
            spoilt_target[1, 0] = bad
            held_target[1, 0] = held.sent[1, 0] if t else q[1, 0]
        sent = spoilt(q, v, spoilt_target)
        assert torch.equal(sent, held(q, v, held_target))
        assert sent.isfinite().all()


@pytest.mark.parametrize(("bad", "when"), NO_NUMBER)
def test_the_exported_step_holds_the_last_target_in_place_of_one_that_is_no_number(
    place, model, bad, when
):
    step = program(delta_step(model, place / "run")).module()
    payload = torch.zeros(3)
    spoilt_frames = torch.zeros(3, 3, 6)
    held_frames = torch.zeros(3, 3, 6)
    fresh = torch.ones(3, dtype=torch.bool)
    for t in range(6):
        q, v, a = drawn(3, seed=t)
        spoilt_target = a.clone()
        held_target = a.clone()
        if t == when:
            spoilt_target[1, 0] = bad
            held_target[1, 0] = held_frames[1, 0, 4] if t else q[1, 0]
        spoilt_delta, spoilt_frames = step(q, v, spoilt_target, payload, spoilt_frames, fresh)
        held_delta, held_frames = step(q, v, held_target, payload, held_frames, fresh)
        fresh = torch.zeros_like(fresh)
        assert torch.equal(spoilt_delta, held_delta)
        assert torch.equal(spoilt_frames, held_frames)
        assert spoilt_frames.isfinite().all()


def test_gradients_reach_the_present_command_and_no_earlier_one(model, place):
    step = program(delta_step(model, place / "run")).module()
    frames = torch.zeros(2, 3, 6)
    fresh = torch.ones(2, dtype=torch.bool)
    payload = torch.zeros(2)
    commands = [x.requires_grad_() for t in range(3) for x in drawn(2, seed=t)[2:]]
    for a in commands:
        q, v, _ = drawn(2)
        delta, frames = step(q, v, a, payload, frames, fresh)
        fresh = torch.zeros_like(fresh)
    gradients = torch.autograd.grad(delta.sum(), commands, allow_unused=True)
    assert gradients[2] is not None
    assert gradients[:2] == (None, None)
    assert not frames.requires_grad


def test_facts_are_the_compiled_simulators(place, model):
    robot = model.simulator()
    facts = read_facts(place / "torch")
    compiled = build_model(robot, 0.1)
    assert facts["simulator"] == model_hash(robot) == model.card["simulator"]
    assert facts["corrected"] == ["shoulder", "elbow"]
    assert (facts["dt"], facts["decimation"], facts["payload_mass"]) == (0.02, 4, 0.1)
    joint = facts["joints"]["shoulder"]
    assert (joint["kp"], joint["effort_limit"], joint["delay"], joint["offset"]) == (
        20.0,
        5.0,
        0.007,
        0.02,
    )
    assert joint["mujoco"]["actuator_forcerange"] == [-5.0, 5.0]
    assert joint["mujoco"]["dof_solimp"] == compiled.dof_solimp[0].tolist()
    assert facts["options"]["integrator"] == "implicitfast"
    assert facts["options"]["timestep"] == 0.005
    built = (
        compiled.dof_invweight0[0]
        / mujoco.MjModel.from_xml_path(str(place / "torch/robot.xml")).dof_invweight0[0]
    )
    assert facts["dof_invweight0_factor"] == pytest.approx(built)


@pytest.mark.parametrize("name", ["so101", "h1_2"])
def test_an_mjcf_with_servos_is_the_simulator(name):
    robot = load_robot(name)
    found = {
        "delay": 0.011,
        "offset": -0.01,
        "zero": 0.02,
        "friction_external": 0.1,
        "damping": 0.7,
    }
    robot = robot.with_identified({robot.operated[1]: found})
    dt = 1 / 60  # no round number of physics steps: all digits count
    again = mujoco.MjModel.from_xml_string(mjcf_text(robot, dt, 0.5))
    own = build_model(robot, 0.5, dt=dt)
    assert list(model_fingerprint(again)) == list(model_fingerprint(own))
    assert again.opt.timestep == own.opt.timestep


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda m: setattr(m.opt, "timestep", 0.001), r"timestep 0\.001"),
        (lambda m: setattr(m.opt, "integrator", 0), "euler"),
        (lambda m: m.actuator_forcerange.fill(0), "actuator_forcerange"),
        (lambda m: m.dof_armature.fill(0.1), "dof_armature"),
        (lambda m: m.dof_solimp.fill(0.9), "dof_solimp"),
        (lambda m: m.actuator_delay.fill(0.0), "actuator_delay"),
        (lambda m: m.actuator_biasprm.fill(0.0), "actuator_biasprm"),
    ],
)
def test_a_scene_that_is_not_the_simulator_of_training_is_refused_with_the_field(
    place, change, said
):
    scene = mujoco.MjModel.from_xml_path(str(place / "torch" / "robot.xml"))
    require_scene(scene, "", place / "torch")
    change(scene)
    with pytest.raises(ValueError, match=said):
        require_scene(scene, "", place / "torch")


def mjlab_servos_of(robot, worlds):
    """Return the servos of a robot in mjlab's scene of that many worlds, with mjlab's model and
    data.
    """
    named = re.sub('="(shoulder|elbow)"', r'="robot/\1"', mjcf_text(robot, robot.dt))
    scene = mujoco.MjModel.from_xml_string(named)
    addresses = servo_addresses(scene, torch.arange(2))
    facts = simulator_facts(robot, robot.dt)
    servos = WorldServos(facts, ["shoulder", "elbow"], addresses, worlds, scene.opt.timestep)
    model = SimpleNamespace(
        dof_frictionloss=torch.zeros(worlds, 2), actuator_biasprm=torch.zeros(worlds, 2, 10)
    )
    model.actuator_forcerange = torch.tensor([[-5.0, 5.0]]).repeat(worlds, 2, 1)
    data = SimpleNamespace(qpos=torch.zeros(worlds, 2), qvel=torch.zeros(worlds, 2))
    data.actuator_force = torch.zeros(worlds, 2)
    data.qfrc_bias = torch.zeros(worlds, 2)
    return servos, model, data


def test_late_servos_of_a_world_that_begins_stay_where_it_begins(model):
    servos, scene, data = mjlab_servos_of(model.simulator(), worlds=3)
    asked = torch.full((3, 2), 0.4)
    for _ in range(4):
        servos.before_step(scene, data, asked)
        servos.after_step(data)
    data.qpos = torch.tensor([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])

    servos.restart(torch.tensor([True, False, True]))
    sent = servos.before_step(scene, data, asked)

    torch.testing.assert_close(sent[[0, 2]], data.qpos[[0, 2]])
    torch.testing.assert_close(sent[1], asked[1])


def test_only_physics_steps_move_the_delays_of_servos_on(model):
    """mjlab asks for a step's targets once more whenever a world begins anew."""
    servos, scene, data = mjlab_servos_of(model.simulator(), worlds=1)
    asked = torch.full((1, 2), 0.4)
    sent = []
    for step in range(4):
        for _ in range(1 + step % 2):
            again = servos.before_step(scene, data, asked)
        servos.after_step(data)
        sent.append(again[0].tolist())
    # late by 7 and 13 ms, in steps of 5 ms
    expected = [[0.0, 0.0], [0.24, 0.0], [0.4, 0.16], [0.4, 0.4]]
    np.testing.assert_allclose(sent, expected, atol=1e-6)


class Wrapped:
    """As Isaac Lab 3 hands out its tensors."""

    def __init__(self, x):
        self.torch = x


class JointPositionAction:
    """The interface that both engines publish for it; their own runs in make engines (mjlab) or
    nowhere (Isaac Lab).
    """

    def __init__(self, dt=0.02):
        self._env = SimpleNamespace(step_dt=dt)
        self.num_envs = 2
        self.device = "cpu"
        self._raw_actions = torch.zeros(2, 2)

    def process_actions(self, actions):
        self._raw_actions[:] = actions
        self._processed_actions = 0.5 * self._raw_actions

    def reset(self, env_ids=None):
        self._raw_actions[env_ids] = 0.0


class Term(AlignedAction, JointPositionAction):
    payload_mass = None


def test_an_action_term_corrects_what_was_processed_in_the_present_state(place):
    term = Term()
    q, v, a = drawn(2)
    term.folder = place / "torch"
    robot = SimpleNamespace(data=SimpleNamespace(joint_pos=Wrapped(q), joint_vel=Wrapped(v)))
    term.align(robot, slice(None), ["shoulder", "elbow"])
    own = Aligner(place / "torch", ["shoulder", "elbow"], 2, "cpu")
    for _ in range(3):
        term.process_actions(a)
        torch.testing.assert_close(term._processed_actions, own(q, v, 0.5 * a))
    term.reset(env_ids=slice(None))
    own.past.reset()
    term.process_actions(a)
    torch.testing.assert_close(term._processed_actions, own(q, v, 0.5 * a))
    other = Term(dt=0.01)
    other.folder = place / "torch"
    with pytest.raises(ValueError, match=r"0\.01"):
        other.align(None, slice(None), ["shoulder", "elbow"])


def test_an_action_term_leaves_a_joint_that_the_export_lacks_without_an_offset(place):
    term = Term()
    term.folder = place / "torch"
    term.align(None, slice(None), ["shoulder", "finger", "elbow"], offset=1.0)
    assert term.servo_offset.tolist() == pytest.approx([LATE["shoulder"]["offset"], 0.0, 0.0])


def test_a_servos_law_in_torch_is_the_simulators(tmp_path):
    rng = np.random.default_rng(0)
    law = {
        "stribeck": 0.1,
        "stribeck_speed": 0.2,
        "friction_motor": 0.05,
        "friction_external": 0.08,
        "min_torque": 0.3,
        "encoder_step": 0.02,
        "no_load_speed": 3.0,
        "backlash": 0.0,  # mjlab has none
    }
    assert set(law) == set(SERVO_TERMS)
    robot = write_arm(tmp_path / "arm").with_identified(
        {"elbow": law | {"offset": 0.1}, "shoulder": {"kp": 11.0}}
    )
    q, v, torque, load, ctrl = rng.uniform(-0.2, 0.2, (5, 20, 2))
    seen = {"qpos": q, "qvel": v, "actuator_force": torque, "qfrc_bias": load}
    found, model, data = mjlab_servos_of(robot, worlds=20)
    vars(data).update({name: torch.tensor(x).float() for name, x in seen.items()})
    found.after_step(data)
    found.before_step(model, data, torch.tensor(ctrl).float())
    terms = {name: robot.servo[name] for name in SERVO_TERMS}
    kp = robot.servo.kp
    friction = friction_limit(terms, np.full(2, 0.05), v, torque, load)
    np.testing.assert_allclose(model.dof_frictionloss, friction, atol=1e-6)
    asked = servo_torque(terms, kp, ctrl + robot.servo.offset, q)
    np.testing.assert_allclose(model.actuator_biasprm[:, :, 0], asked - kp * (ctrl - q), atol=1e-5)
    limits = np.stack([np.full(20, 5.0), 5.0 * np.minimum(1 - v[:, 1] / 3.0, 1)], axis=1)
    np.testing.assert_allclose(model.actuator_forcerange[:, :, 1], limits, atol=1e-5)
    found.restart()
    found.starts_under_command = True
    found.before_step(model, data, data.qpos + 0.01)
    np.testing.assert_allclose(
        found.torque, np.tile(kp * (robot.servo.offset + 0.01), (20, 1)), atol=1e-6
    )


def test_worlds_that_share_one_friction_are_refused(place):
    robot = write_arm(place / "arm_with_law").with_identified({"elbow": {"friction_motor": 0.1}})
    servos, model, data = mjlab_servos_of(robot, worlds=2)
    model.dof_frictionloss = torch.zeros(1, 2).expand(2, 2)
    with pytest.raises(ValueError, match="mjlab_events"):
        servos.before_step(model, data, torch.zeros(2, 2))


def isaac_lab(monkeypatch):
    """What Isaac Lab 3 publishes of itself; its own physics is tried in make engines."""

    @dataclass
    class Servos:
        joint_names_expr: list
        stiffness: dict
        damping: dict
        armature: dict
        friction: dict
        viscous_friction: dict
        actuator_effort_limit: dict

    @dataclass
    class Motors(Servos):
        saturation_effort: float
        actuator_velocity_limit: float

    @dataclass
    class Config:
        class_type: object = None
        use_default_offset: bool = True

    modules = {
        "isaaclab": {},
        "isaaclab.envs": {},
        "isaaclab.envs.mdp.actions": {},
        "isaaclab.utils": {"configclass": dataclass},
        "isaaclab.actuators": {"IdealPDActuatorCfg": Servos, "DCMotorCfg": Motors},
        "isaaclab.envs.mdp": {"JointPositionActionCfg": Config},
        "isaaclab.envs.mdp.actions.joint_actions": {"JointPositionAction": JointPositionAction},
    }
    for name, content in modules.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**content))


def test_isaac_labs_classes_are_found_by_name_as_hydra_looks_for_them(place, monkeypatch):
    isaac_lab(monkeypatch)
    config = gaponet_action.isaaclab_action(place / "torch")
    there = f"{config.class_type.__module__}:{config.class_type.__qualname__}"
    assert there == "gaponet.export.shipped.gaponet_action:IsaacLabTerm"
    assert (
        config.class_type is gaponet_action.IsaacLabTerm is gaponet_action.__dict__["IsaacLabTerm"]
    )
    assert config.class_type.__doc__
    assert config.folder == str(place / "torch")
    (servos,) = isaaclab_actuators(place / "torch").values()
    assert servos.stiffness == {"shoulder": 20.0, "elbow": 20.0}
    assert servos.actuator_effort_limit == {"shoulder": 5.0, "elbow": 5.0}


def test_a_joint_with_a_no_load_speed_is_isaac_labs_dc_motor(tmp_path, monkeypatch):
    isaac_lab(monkeypatch)
    robot = write_arm(tmp_path / "arm").with_identified(
        {"elbow": {"no_load_speed": 4.0, "kp": 11.0}}
    )
    export_robot(robot, "isaaclab", tmp_path / "out")
    servos, motor = isaaclab_actuators(tmp_path / "out").values()
    assert servos.joint_names_expr == ["shoulder"]
    assert (motor.joint_names_expr, motor.stiffness) == (["elbow"], {"elbow": 11.0})
    assert (motor.saturation_effort, motor.actuator_velocity_limit) == (5.0, 4.0)


def test_targets_under_way_in_the_term_are_late_by_parts_of_a_step_and_begin_at_rest():
    class Engine:
        num_envs = 2
        device = "cpu"
        servo_offset = torch.tensor([0.1, 0.0])
        _env = SimpleNamespace(physics_dt=0.005)
        aligner = SimpleNamespace(past=SimpleNamespace(fresh=torch.tensor([True, True])))

        def apply_actions(self):
            self.told = self._processed_actions

    class Late(DelayedAction, Engine):
        pass

    term = Late()
    term.set_delays([[0.007, 0.0]])
    term.restart(torch.ones(2, 2), torch.zeros(2, 2))
    term.aligner.past.fresh = torch.tensor([False, False])
    term._processed_actions = torch.ones(2, 2)
    told = []
    for _ in range(3):
        term.apply_actions()
        told.append(term.told[0].tolist())
    assert np.allclose(told, [[0.1, 1.0], [0.6 + 0.4 * 0.1, 1.0], [1.0, 1.0]])
    assert (term._processed_actions == 1.0).all()


def test_friction_is_made_to_hold_in_every_world(place):
    scene = mujoco.MjModel.from_xml_string(
        re.sub('="(shoulder|elbow)"', r'="robot/\1"', (place / "torch/robot.xml").read_text())
    )
    shared = torch.tensor(scene.dof_invweight0)[None].repeat(3, 1)
    sim = SimpleNamespace(mj_model=scene, model=SimpleNamespace(dof_invweight0=shared.clone()))
    hold_friction(sim, "robot", place / "torch")
    np.testing.assert_allclose(sim.model.dof_invweight0, 0.1 * shared)


def test_the_command_writes_a_folder_that_needs_no_gaponet(place, capsys):
    files = {f.name for f in (place / "torch").iterdir()}
    shared = {
        "facts.json",
        "robot.xml",
        "gaponet_action.py",
    }
    assert files == shared | {".gaponet", "delta.pt2", "robot_without_servos.xml"}
    assert not [
        f
        for f in (place / "torch").glob("*.py")
        if re.search(r"^(from|import) gaponet", f.read_text(), re.M)
    ]
    assert mujoco.MjModel.from_xml_path(str(place / "torch/robot_without_servos.xml")).nu == 0
    assert main(["export", str(place / "run"), "--to", "torch", "--payload-mass", "9"]) == 2
    assert "9 kg is outside" in capsys.readouterr().err
    assert not (place / "run" / "torch").exists()


@pytest.mark.parametrize("kind", ["paper", "mlp"])
def test_every_kind_of_network_ships(tmp_path, kind):
    model = random_run(tmp_path / "run", write_arm(tmp_path / "arm"), kind=kind)
    assert export_model(model, tmp_path / "run", tmp_path / "torch") <= 1e-5


@pytest.mark.parametrize(
    "how",
    [
        {"delta_hold": 2},
        {"real_state": True},
        {"predictor_inputs": "equation_1"},
        {"sensor_source": "fixed"},
    ],
)
def test_a_model_with_inputs_or_memory_that_a_program_lacks_is_refused(tmp_path, how):
    model = SimpleNamespace(config=ModelConfig(kind="paper", **how), path=tmp_path)
    with pytest.raises(ModelError, match="train"):
        delta_step(model, tmp_path)
