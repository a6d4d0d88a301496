"""Whole units in the worlds of mjlab and Isaac Lab, in stand-ins with the methods of these
engines.
"""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import mujoco
import pytest
import torch
from arm import XML

from gaponet.export.shipped.gaponet_action import DelayedAction
from gaponet.export.shipped.unit_events import apply_units, mjlab_units

FIELDS = ("kp", "effort_limit", "damping", "frictionloss", "armature", "offset", "delay")
STEP = 0.005
WORLDS = 6
UNITS = 4


@pytest.fixture
def file(tmp_path):
    """Four units of two joints; all numbers differ, and delays are 1 to 4 steps."""
    numbers = torch.arange(1.0, 1 + len(FIELDS) * UNITS * 2).reshape(len(FIELDS), UNITS, 2) / 100
    units = dict(zip(FIELDS, numbers, strict=True))
    units["delay"] = STEP * torch.arange(1.0, 1 + UNITS)[:, None].expand(UNITS, 2)
    plain = {field: x.tolist() for field, x in units.items()}
    with_model = {field: (-x).tolist() for field, x in units.items()}
    content = {"joints": ["shoulder", "elbow"], "units": with_model, "plain_units": plain}
    links = torch.rand(UNITS, 2, 11, generator=torch.Generator().manual_seed(0)).tolist()
    with_model["links"] = plain["links"] = links
    content["bodies"] = ["upper", "fore"]
    (tmp_path / "randomization.json").write_text(json.dumps(content))
    return str(tmp_path / "randomization.json")


class Buffer:
    def __init__(self):
        self.time_lags = torch.zeros(WORLDS, dtype=torch.int)

    def set_time_lag(self, time_lag, batch_ids=None):
        self.time_lags[batch_ids] = time_lag


def group(*names, implicit=False, limit="effort_limit", delayed=False):
    made = SimpleNamespace(joint_names=list(names), is_implicit_model=implicit)
    made.stiffness = torch.full((WORLDS, len(names)), 7.0)
    setattr(made, limit, made.stiffness.clone())
    if delayed:
        made.positions_delay_buffer, made.velocities_delay_buffer, made.efforts_delay_buffer = (
            Buffer() for _ in "pve"
        )
    return made


class Robot:
    """Joints in an order of its own, and one that no unit has."""

    joint_names = ("head", "elbow", "shoulder")

    def __init__(self, *groups):
        self.actuators = {f"group{i}": g for i, g in enumerate(groups)}
        self.sim = {}

    def note(self, what, values, joint_ids, env_ids):
        column = self.sim.setdefault(what, torch.full((WORLDS, 3), 7.0))
        column[env_ids[:, None], torch.tensor(joint_ids)] = values


class Robot2(Robot):
    """Articulation of Isaac Lab 2.3."""

    def write_joint_stiffness_to_sim(self, stiffness, joint_ids=None, env_ids=None):
        self.note("kp", stiffness, joint_ids, env_ids)

    def write_joint_effort_limit_to_sim(self, limits, joint_ids=None, env_ids=None):
        self.note("effort_limit", limits, joint_ids, env_ids)

    def write_joint_armature_to_sim(self, armature, joint_ids=None, env_ids=None):
        self.note("armature", armature, joint_ids, env_ids)

    def write_joint_friction_coefficient_to_sim(
        self,
        joint_friction_coeff,
        joint_dynamic_friction_coeff=None,
        joint_viscous_friction_coeff=None,
        joint_ids=None,
        env_ids=None,
    ):
        self.note("frictionloss", joint_friction_coeff, joint_ids, env_ids)
        self.note("dynamic", joint_dynamic_friction_coeff, joint_ids, env_ids)
        self.note("damping", joint_viscous_friction_coeff, joint_ids, env_ids)

    def write_joint_dynamic_friction_coefficient_to_sim(
        self, joint_dynamic_friction_coeff, joint_ids, env_ids
    ):
        raise AssertionError("it may not exceed the static coefficient of the unit before")


class Robot3(Robot):
    """Articulation of Isaac Lab 3 on Newton."""

    def write_joint_stiffness_to_sim_index(self, *, stiffness, joint_ids=None, env_ids=None):
        self.note("kp", stiffness, joint_ids, env_ids)

    def write_joint_effort_limit_to_sim_index(self, *, limits, joint_ids=None, env_ids=None):
        self.note("effort_limit", limits, joint_ids, env_ids)

    def write_joint_armature_to_sim_index(self, *, armature, joint_ids=None, env_ids=None):
        self.note("armature", armature, joint_ids, env_ids)

    def write_joint_friction_coefficient_to_sim_index(
        self,
        *,
        joint_friction_coeff,
        joint_dynamic_friction_coeff=None,
        joint_viscous_friction_coeff=None,
        joint_ids=None,
        env_ids=None,
    ):
        assert joint_dynamic_friction_coeff is None  # it would warn
        self.note("frictionloss", joint_friction_coeff, joint_ids, env_ids)
        self.note("damping", joint_viscous_friction_coeff, joint_ids, env_ids)


class Action(DelayedAction):
    """Action term of isaaclab_action, with joints in an order of its own."""

    num_envs = WORLDS
    device = "cpu"
    _joint_names = ("elbow", "head", "shoulder")
    servo_offset = torch.tensor([0.5, 0.5, 0.5])
    _env = SimpleNamespace(physics_dt=STEP)

    def __init__(self):
        self.set_delays([[0.0, 0.0, STEP]])


def environment(robot, term):
    actions = SimpleNamespace(get_term={"joint_pos": term}.__getitem__)
    return SimpleNamespace(
        num_envs=WORLDS,
        device="cpu",
        physics_dt=STEP,
        scene={"robot": robot},
        action_manager=actions,
    )


def stored(file, joint):
    content = json.loads(Path(file).read_text())
    plain = {f: x for f, x in content["plain_units"].items() if f != "links"}
    return {f: torch.tensor(x)[:, content["joints"].index(joint)] for f, x in plain.items()}


ROBOT = SimpleNamespace(name="robot")


RESET = (0, 1, 2, 3, 5)  # world 4 goes on
COLUMNS = {"elbow": 1, "shoulder": 2}  # in the articulation
PLACES = {"elbow": 0, "shoulder": 2}  # in the action term


@pytest.fixture(params=[(Robot2, "effort_limit"), (Robot3, "actuator_effort_limit")])
def drawn(request, file):
    """Units were drawn for the worlds RESET: the shoulder's actuator is implicit, the elbow's
    explicit, in the second column of its group.
    """
    torch.manual_seed(0)
    kind, limit = request.param
    implicit = group("shoulder", implicit=True)
    explicit = group("head", "elbow", limit=limit)
    robot = kind(implicit, explicit)
    term = Action()
    apply_units(environment(robot, term), torch.tensor(RESET), ROBOT, file)
    return SimpleNamespace(
        file=file,
        robot=robot,
        term=term,
        implicit=implicit,
        explicit=explicit,
        explicit_limit=getattr(explicit, limit),
    )


def row_of(drawn, world):
    """The row of the unit that a world has, by the armature of its elbow."""
    armature = stored(drawn.file, "elbow")["armature"]
    return int((armature - drawn.robot.sim["armature"][world, COLUMNS["elbow"]]).abs().argmin())


def unit_of(drawn, world, joint):
    """Numbers of a joint of the unit that a world has."""
    row = row_of(drawn, world)
    return {field: float(x[row]) for field, x in stored(drawn.file, joint).items()}


@pytest.mark.parametrize("joint", COLUMNS)
def test_every_world_of_isaac_lab_gets_the_passive_numbers_of_its_unit_by_joint_name(drawn, joint):
    for world in RESET:
        unit = unit_of(drawn, world, joint)
        for field in ("armature", "frictionloss", "damping"):
            simulated = float(drawn.robot.sim[field][world, COLUMNS[joint]])
            assert simulated == pytest.approx(unit[field])


@pytest.mark.parametrize("joint", COLUMNS)
def test_the_action_term_of_isaac_lab_gets_offsets_and_delays_of_the_unit(drawn, joint):
    for world in RESET:
        unit = unit_of(drawn, world, joint)
        offset = float(drawn.term.servo_offset[world, PLACES[joint]])
        delay = float(drawn.term.delay[world, PLACES[joint]])
        assert offset == pytest.approx(unit["offset"])
        assert delay == pytest.approx(unit["delay"])


def test_implicit_actuators_get_the_gain_in_the_simulation_and_the_limit_as_well(drawn):
    for world in RESET:
        unit = unit_of(drawn, world, "shoulder")
        assert float(drawn.robot.sim["kp"][world, 2]) == pytest.approx(unit["kp"])
        assert float(drawn.implicit.effort_limit[world, 0]) == pytest.approx(unit["effort_limit"])


def test_explicit_actuators_get_gain_and_limit_and_the_simulation_has_no_gain_of_them(drawn):
    for world in RESET:
        unit = unit_of(drawn, world, "elbow")
        assert float(drawn.explicit.stiffness[world, 1]) == pytest.approx(unit["kp"])
        assert float(drawn.explicit_limit[world, 1]) == pytest.approx(unit["effort_limit"])
    assert (drawn.robot.sim["kp"][:, COLUMNS["elbow"]] == 7.0).all()


def test_worlds_of_isaac_lab_get_different_units(drawn):
    assert len({row_of(drawn, world) for world in RESET}) > 1


def test_a_world_that_was_not_reset_keeps_its_numbers(drawn):
    for values in drawn.robot.sim.values():
        assert (values[4] == 7.0).all()
    assert (drawn.term.servo_offset[4] == 0.5).all()


def test_a_joint_that_no_unit_has_keeps_its_numbers(drawn):
    for values in drawn.robot.sim.values():
        assert (values[:, 0] == 7.0).all()
    assert (drawn.explicit.stiffness[:, 0] == 7.0).all()


@pytest.mark.parametrize("drawn", [(Robot2, "effort_limit")], indirect=True)
def test_isaac_lab_2_gets_dynamic_friction_equal_to_the_static_one(drawn):
    assert torch.equal(drawn.robot.sim["dynamic"], drawn.robot.sim["frictionloss"])


def test_rows_may_be_given_and_commands_are_then_late_by_the_delay_of_each_world(file):
    class Engine:
        def apply_actions(self):
            self.sent = self._processed_actions.clone()

    class Term(Action, Engine):
        pass

    robot = Robot3(group("shoulder", "elbow", "head"))
    term = Term()
    apply_units(environment(robot, term), None, ROBOT, file, rows=[0, 1, 2, 3, 3, 0])
    torch.testing.assert_close(
        robot.sim["armature"][:, 2], stored(file, "shoulder")["armature"][[0, 1, 2, 3, 3, 0]]
    )
    term._processed_actions = torch.ones(WORLDS, 3)
    first = torch.zeros(WORLDS)
    for _ in range(6):
        first += term.sent[:, 2] == 0.0 if hasattr(term, "sent") else 0.0
        term.apply_actions()
    assert first.tolist() == [1.0, 2.0, 3.0, 4.0, 4.0, 1.0]


def test_delayed_actuators_are_late_by_whole_steps_where_no_action_term_delays(file):
    robot = Robot3(*(group(name, delayed=True) for name in Robot.joint_names))
    apply_units(
        environment(robot, None), slice(0, 3), ROBOT, file, term=None, rows=[0, 1, 2, 3, 3, 3]
    )
    elbow = robot.actuators["group1"]
    assert elbow.positions_delay_buffer.time_lags.tolist() == [1, 2, 3, 0, 0, 0]
    assert elbow.efforts_delay_buffer.time_lags.tolist() == [1, 2, 3, 0, 0, 0]
    with pytest.raises(ValueError, match="DelayedPDActuatorCfg"):
        apply_units(
            environment(Robot3(group("elbow", "shoulder")), None), None, ROBOT, file, term=None
        )
    content = json.loads(Path(file).read_text())
    content["plain_units"]["delay"][0][1] = 0.05
    Path(file + "2").write_text(json.dumps(content))
    both = Robot3(group("elbow", "shoulder", delayed=True))
    with pytest.raises(ValueError, match="group"):
        apply_units(environment(both, None), None, ROBOT, file + "2", term=None, rows=[0] * WORLDS)


@pytest.mark.parametrize("executors", [False, True])
def test_dc_motors_of_isaac_lab_get_the_torque_speed_line_of_a_unit(file, executors):
    content = json.loads(Path(file).read_text())
    content["plain_units"]["no_load_speed"] = [[3.0, 0.0], [4.0, 0.0], [5.0, 0.0], [6.0, 0.0]]
    Path(file).write_text(json.dumps(content))

    def motor(*names):
        made = group(*names)
        made._saturation_effort = 7.0
        made.velocity_limit = torch.full((WORLDS, len(names)), 9.0)
        made._vel_at_effort_lim = 2 * made.velocity_limit
        return made

    own = motor("shoulder")
    whole = motor("elbow", "shoulder")
    robot = Robot3(own, group("elbow", "head"))
    if executors:
        robot.actuators = type(
            "Collection", (dict,), {"_execution_batches": [SimpleNamespace(actuator=whole)]}
        )(robot.actuators)
    apply_units(
        environment(robot, Action()), torch.tensor([0, 1, 4]), ROBOT, file, rows=[0, 1, 2, 3, 3, 0]
    )
    limit = stored(file, "shoulder")["effort_limit"]
    for made, column in [(own, 0), (whole, 1)][: 1 + executors]:
        assert made.velocity_limit[:, column].tolist() == [3.0, 4.0, 9.0, 9.0, 6.0, 9.0]
        assert made._vel_at_effort_lim[:, column].tolist() == [6.0, 8.0, 18.0, 18.0, 12.0, 18.0]
        torch.testing.assert_close(made._saturation_effort[[0, 1, 4], column], limit[[0, 1, 3]])
        assert (made._saturation_effort[[2, 3, 5]] == 7.0).all()
    if executors:
        assert (whole.velocity_limit[[0, 1, 4], 0] == torch.inf).all()  # a speed of 0 is no line
    with pytest.raises(ValueError, match="isaaclab_actuators"):
        apply_units(environment(Robot3(group("shoulder", "elbow")), Action()), None, ROBOT, file)


def test_a_scene_that_cannot_have_a_number_of_a_unit_is_refused(file):
    whole = group("shoulder", "elbow")

    def refused(robot, term, message):
        with pytest.raises(ValueError, match=message):
            apply_units(environment(robot, term), None, ROBOT, file)
        assert robot.sim == {}

    other = Robot3(whole)
    other.joint_names = ("head", "elbow")
    refused(other, Action(), "has joint 'shoulder'; joints of the articulation: head, elbow")
    refused(Robot3(group("elbow")), Action(), "has joint 'shoulder'; joints with PD actuators")
    refused(
        Robot3(SimpleNamespace(joint_names=["shoulder", "elbow"], network=0)),
        Action(),
        "joints with PD actuators",
    )
    refused(Robot3(whole), object(), "'joint_pos' has no delays and offsets; use isaaclab_action")
    refused(Robot(whole), Action(), "write_joint_armature_to_sim is missing")


def test_mjlab_s_own_position_servos_get_units_without_the_servo_model_by_joint_name(
    file, monkeypatch
):
    mark = lambda *fields: lambda func: setattr(func, "fields", fields) or func  # noqa: E731
    modules = {
        "mjlab": {},
        "mjlab.managers": {},
        "mjlab.managers.event_manager": {"requires_model_fields": mark},
    }
    for name, content in modules.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**content))
    servos = (
        '<position joint="robot/elbow" kp="1"/><position joint="robot/shoulder" kp="1"/>'
        '<velocity joint="robot/shoulder" kv="1"/>'
    )
    xml = XML.replace('name="shoulder"', 'name="robot/shoulder"').replace(
        'name="elbow"', 'name="robot/elbow"'
    )
    xml = xml.replace('name="upper"', 'name="robot/upper"').replace(
        'name="fore"', 'name="robot/fore"'
    )
    scene = mujoco.MjModel.from_xml_string(
        xml.replace("</mujoco>", f"<actuator>{servos}</actuator></mujoco>")
    )
    event = mjlab_units(file, rows=[0, 1, 2, 3, 3, 3])
    fields = {f: torch.tensor(getattr(scene, f)).float() for f in event.fields}
    worlds = {f: x.expand(WORLDS, *x.shape).clone() for f, x in fields.items()}
    env = environment(None, SimpleNamespace(cfg=SimpleNamespace(entity_name="robot")))
    env.sim = SimpleNamespace(mj_model=scene, model=SimpleNamespace(**worlds))
    env.scene = {"robot": SimpleNamespace(actuators=[SimpleNamespace()])}
    event(env, torch.tensor([1, 3]))
    kp = stored(file, "shoulder")["kp"]
    torch.testing.assert_close(
        worlds["actuator_gainprm"][[0, 1, 3], 1, 0], torch.stack([torch.tensor(1.0), kp[1], kp[3]])
    )
    dof = scene.joint("robot/elbow").dofadr[0]
    unit = {field: float(x[3]) for field, x in stored(file, "elbow").items()}
    assert float(worlds["dof_frictionloss"][3, dof]) == pytest.approx(unit["frictionloss"])
    assert float(worlds["actuator_biasprm"][3, 0, 0]) == pytest.approx(unit["kp"] * unit["offset"])
    assert worlds["actuator_forcerange"][3, 0].tolist() == pytest.approx(
        [-unit["effort_limit"], unit["effort_limit"]]
    )
    link = torch.tensor(json.loads(Path(file).read_text())["plain_units"]["links"])[3]
    for i, name in enumerate(("upper", "fore")):
        one = [
            worlds[f"body_{f}"][3, scene.body(f"robot/{name}").id].reshape(-1)
            for f in ("mass", "ipos", "inertia", "iquat")
        ]
        torch.testing.assert_close(torch.cat(one), link[i])
    torch.testing.assert_close(worlds["body_subtreemass"][3, :2], link[:, 0].sum().expand(2))
    assert worlds["body_mass"][0, 1] == float(scene.body_mass[1])  # a world that was not reset
    assert (worlds["actuator_gainprm"][:, 2, 0] == 1.0).all()  # of the velocity servo
    scene.actuator_biasprm[2, 1] = -1.0
    with pytest.raises(ValueError, match="'robot/shoulder' has several position servos"):
        event(env, None)
    scene.actuator_biastype[:] = 0
    with pytest.raises(ValueError, match="robot/shoulder"):
        event(env, None)
