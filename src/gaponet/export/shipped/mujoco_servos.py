"""Identified servos in plain MuJoCo.

This file is copied into exports; it needs MuJoCo and numpy, not gaponet.

    servos = Servos(model, read("facts.json"))  # once; prefix="left/" if attached to a scene
    data.ctrl[...] = …
    fill_delays(model, data)  # after each reset
    data.ctrl[...] = …
    servos.before(data)  # mj_forward before it, where you changed the state
    mujoco.mj_step(model, data)
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.sim.servo import Play, friction_limit, present, servo_bias, torque_range

CHECK_WORLDS = 3
SLEW_MAX = 1  # place of slewmax in the dynprm of a <pid>
MAX_RAMP_LEAD_RAD = 0.05  # of a limited target beyond its joint at a start, and at its speed
MAX_RAMP_LEAD_S = 0.1
Motion = dict[str, Any]  # one of check.npz: ctrl, qpos, qvel (T, n) in rad and rad/s, dt in s


def read(path: str | Path) -> dict[str, Any]:
    """Read the facts.json of an export."""
    facts: dict[str, Any] = json.loads(Path(path).read_text(encoding="utf-8"))
    if facts["format"] != 2:
        raise ValueError(f"{path}: written by another version of gaponet; export the robot again")
    return facts


class Addresses(NamedTuple):
    """Places of joints in MuJoCo's model and data, (n) each: indices, or tensors of them."""

    dof: Any  # in qvel
    qpos: Any
    servo: Any  # of the actuators that drive the joints


class ServoNumbers(NamedTuple):
    """Numbers of servos, and what follows from them in a physics step: numpy arrays or tensors.

    Each has the joints as its last axis.
    """

    kp: Any  # N·m/rad
    bias: Any  # torque of the zero offset, N·m
    frictionloss: Any  # N·m
    effort: Any  # torque limit, N·m
    terms: dict[str, Any]  # of the servo model, as of `present`

    def friction(self, qvel: Any, torque: Any, load: Any) -> Any:
        """Return the limit of friction, N·m, under the motor's torque and gravity's."""
        return friction_limit(self.terms, self.frictionloss, qvel, torque, load)

    def torque_limits(self, qvel: Any) -> tuple[Any, Any]:
        """Return the least and the largest torque of motors with a no-load speed, N·m."""
        limits: tuple[Any, Any] = torque_range(self.effort, qvel / self.terms["no_load_speed"])
        return limits

    def step_bias(self, target: Any, qpos: Any) -> Any:
        """Return the actuators' bias for a step under targets, N·m."""
        return servo_bias(self.terms, self.kp, self.bias, target, qpos)


class Servos:
    """Servos of a compiled model.

    Sets the identified numbers once, and the servo model before each step.
    """

    def __init__(self, model: Any, facts: dict[str, Any], prefix: str = "") -> None:
        """
        Args:
            prefix: Text before each joint's name in the model.
        """
        import mujoco

        stiffness = _friction_stiffness(model)
        joints = facts["joints"]
        column = {}
        for field, value in next(iter(joints.values())).items():
            if isinstance(value, int | float):
                column[field] = np.array([joint.get(field, 0.0) for joint in joints.values()])
        self.model = model
        self.at = addresses(model, list(joints), prefix)
        dof, qpos, servo = self.at
        self.numbers = ServoNumbers(
            kp=column["kp"],
            bias=column["kp"] * column["offset"],
            frictionloss=column["frictionloss"],
            effort=column["effort_limit"],
            terms=present({name: column[name] for name in SERVO_TERMS if name in column}),
        )
        model.dof_armature[dof] = column["armature"]
        model.dof_damping[dof, ...] = column["damping"]
        # A servo that limits the speed of its targets (<pid slewmax>) has its stiffness in biasprm
        # alone.
        self._ramped = np.array([ramp_speed(model, i) > 0 for i in servo])
        model.actuator_gainprm[servo, 0] = np.where(self._ramped, 0.0, column["kp"])
        model.actuator_biasprm[servo, 0] = self.numbers.bias
        model.actuator_biasprm[servo, 1] = -column["kp"]
        model.actuator_biasprm[servo, 2] = -column["kd"]
        effort = self.numbers.effort
        model.actuator_forcerange[servo] = np.stack([-effort, effort], axis=-1)
        model.dof_frictionloss[dof] = column["frictionloss"]
        model.qpos0[qpos] += (
            np.array([facts["plain"][name]["zero"] for name in joints]) - column["zero"]
        )
        if model.nhistory:
            model.actuator_delay[servo] = column["delay"]
        # Friction is made stiff, which no MJCF can express; that of other arms stays as it is.
        mujoco.mj_setConst(model, mujoco.MjData(model))
        stiffness[dof] = facts["dof_invweight0_factor"]
        model.dof_invweight0 *= stiffness
        self._backlash: Backlash | None = None
        if "backlash" in self.numbers.terms:
            self._backlash = Backlash(model, self.at, column)

    def before(self, data: Any) -> None:
        """Set bias, torque limits and friction for the next physics step, under data.ctrl.

        With backlash, also qfrc_applied, and armature, damping and gear of the model.
        """
        numbers = self.numbers
        if not numbers.terms:
            return
        model = self.model
        dof, qpos, servo = self.at
        q = data.qpos[qpos]
        qvel = data.qvel[dof]
        friction = numbers.friction(qvel, data.actuator_force[servo], data.qfrc_bias[dof])
        if "no_load_speed" in numbers.terms:
            limits = numbers.torque_limits(qvel)
            model.actuator_forcerange[servo] = np.stack(limits, axis=-1)
        bias = numbers.step_bias(self._targets_in_force(data), q)
        if self._backlash is not None:
            friction, more = self._backlash.before(data, q, qvel, friction)
            bias = bias + more
        model.dof_frictionloss[dof] = friction
        model.actuator_biasprm[servo, 0] = bias

    def _targets_in_force(self, data: Any) -> Any:
        """Return the targets of the next physics step, rad.

        Where a servo limits their speed, these are the targets so far.
        """
        servo = self.at.servo
        targets = np.array(data.ctrl[servo])
        for k in np.flatnonzero(self._ramped):
            i = servo[k]
            step = self.model.opt.timestep * ramp_speed(self.model, i)
            now = data.act[self.model.actuator_actadr[i]]
            targets[k] = np.clip(targets[k], now - step, now + step)
        return targets


class Backlash:
    """Backlash of the servos of a compiled model; it begins anew where a state was written."""

    def __init__(self, model: Any, at: Addresses, column: dict[str, Any]) -> None:
        """
        Args:
            column: Field → (n) numbers of the servos, as in facts.json.
        """
        self.model = model
        self.at = at
        self._column = column
        self._play: Play | None = None
        self._next_time = np.nan  # s, at which this state goes on

    def before(self, data: Any, qpos: Any, qvel: Any, friction: Any) -> tuple[Any, Any]:
        """Write armature, damping, gear and applied torque of the links for the next physics step.

        Args:
            qpos, qvel: State of the joints, (n) rad and rad/s.
            friction: Limit of friction of the motors, N·m.

        Returns:
            Limit of friction of the links, and the bias that their actuators need besides, N·m.
        """
        model = self.model
        dof, _, servo = self.at
        column = self._column
        h = model.opt.timestep
        if self._play is None or data.time != self._next_time:
            motor = column["armature"], column["damping"], column["kd"]
            self._play = Play(column["backlash"], *motor, data.qfrc_bias[dof], qvel)
        else:
            self._play.after(qvel, data.actuator_force[servo], data.qfrc_constraint[dof], h)
        values = self._play.before(friction, column["kp"], qpos, qvel, h)
        friction, armature, damping, applied, gear, bias = values
        model.dof_armature[dof] = armature
        model.dof_damping[dof, ...] = damping
        data.qfrc_applied[dof] = applied
        model.actuator_gear[servo, 0] = gear
        self._next_time = data.time + h
        return friction, bias


def ramp_speed(model: Any, actuator: int) -> float:
    """Return the limit of the speed of an actuator's targets, rad/s; 0: none."""
    import mujoco

    pid = getattr(mujoco.mjtDyn, "mjDYN_PID", None)
    if pid is None or model.actuator_dyntype[actuator] != pid:
        return 0.0
    return max(float(model.actuator_dynprm[actuator, SLEW_MAX]), 0.0)


def addresses(model: Any, joints: list[str], prefix: str = "") -> Addresses:
    """Return the places of joints and of the actuators that drive them."""
    import mujoco

    ids = [model.joint(prefix + name).id for name in joints]
    on_joint = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    of_joint = np.where(np.isin(model.actuator_trntype, on_joint), model.actuator_trnid[:, 0], -1)
    servos = np.array([np.flatnonzero(of_joint == joint)[0] for joint in ids])
    return Addresses(model.jnt_dofadr[ids], model.jnt_qposadr[ids], servos)


def _friction_stiffness(model: Any) -> Any:
    """Return by what each degree of freedom's mobility was changed after mj_setConst, (nv,)."""
    import mujoco

    plain = copy.copy(model)
    mujoco.mj_setConst(plain, mujoco.MjData(plain))
    ratio = np.ones(model.nv)
    moves = plain.dof_invweight0 > 0
    ratio[moves] = model.dof_invweight0[moves] / plain.dof_invweight0[moves]
    return ratio


def fill_delays(model: Any, data: Any) -> None:
    """Let each delayed actuator act as if data.ctrl had always been in force.

    MuJoCo's reset lets it begin at 0.

    Where a servo limits the speed of its targets, these begin at most 0.05 rad and the way of 0.1 s
    from the joint.
    """
    import mujoco

    for i in range(len(model.actuator_trnid)):
        speed = ramp_speed(model, i)
        if speed > 0:
            position = data.qpos[model.jnt_qposadr[model.actuator_trnid[i, 0]]]
            lead = MAX_RAMP_LEAD_RAD + MAX_RAMP_LEAD_S * speed
            start = np.clip(data.ctrl[i], position - lead, position + lead)
            data.act[model.actuator_actadr[i]] = start
    for i, samples in enumerate(model.actuator_history[:, 0] if model.nhistory else ()):
        if samples:
            mujoco.mj_initCtrlHistory(model, data, i, None, np.full(samples, data.ctrl[i]))


def play(
    model: Any, facts: dict[str, Any], motion: Motion, prefix: str = "", form: str = "joints"
) -> Any:
    """Play a motion in plain MuJoCo from its first state.

    Its first command counts as if it had always been in force.

    Args:
        model: Compiled; its physics step is changed to divide the motion's period.
        prefix: Text before each joint's name in the model.
        form: "joints" applies the servo model; "plain" leaves the model as it is.

    Returns:
        Positions of the recorded joints, (T, n) rad.
    """
    import mujoco

    names = list(facts["joints"])
    ctrl = motion["ctrl"]
    qpos = np.array(motion["qpos"])
    steps = max(1, round(float(motion["dt"]) / model.opt.timestep))
    model.opt.timestep = float(motion["dt"]) / steps
    servos = Servos(model, facts, prefix) if form == "joints" else None
    data = mujoco.MjData(model)
    at = addresses(model, names, prefix)
    data.qpos[at.qpos] = qpos[0]
    data.qvel[at.dof] = motion["qvel"][0]
    data.ctrl[at.servo] = ctrl[0]
    fill_delays(model, data)
    mujoco.mj_forward(model, data)
    for t in range(len(ctrl) - 1):
        data.ctrl[at.servo] = ctrl[t]
        for _ in range(steps):
            if servos is not None:
                servos.before(data)
            mujoco.mj_step(model, data)
        qpos[t + 1] = data.qpos[at.qpos]
    return qpos


def delay_weights(delay: Any, step: float) -> Any:
    """Return weights of past commands, for engines whose actuators have no delay.

        past = np.concatenate([ctrl[None], past[:-1]])  # (depth, n), newest first
        target = (weights * past).sum(0)

    This is MuJoCo's delay with interp="linear". At the start, past is the first command repeated.

    Args:
        delay: (n,) s.
        step: Physics step, s.

    Returns:
        (depth, n), the newest command first.
    """
    steps = np.asarray(delay, float) / step
    age = np.arange(int(np.ceil(steps.max(initial=0.0) - 1e-9)) + 1)[:, None]
    return np.maximum(0.0, 1.0 - abs(age - steps))


class Check:
    """The motions of an export's check.npz, arranged in a few worlds.

    So worlds restart while others go on.

    Attributes:
        facts: facts.json.
        names: Joints, in the order of all arrays.
        motions: The motions.
        step: Physics step, s.
        ctrl: (T, worlds, n) rad; the last command stays in force in a world without another motion.
        starts: Period → world → motion that starts there.
    """

    def __init__(self, folder: Path) -> None:
        self.facts = read(folder / "facts.json")
        stored = np.load(folder / "check.npz")
        self.names = list(self.facts["joints"])
        self.motions: list[Motion] = []
        for i in range(int(stored["count"])):
            motion = {name: stored[f"{name}_{i}"] for name in ("ctrl", "qpos", "qvel", "dt")}
            self.motions.append(motion)
        self.step = float(np.median([m["dt"] for m in self.motions])) / self.facts["decimation"]
        self.worlds = min(CHECK_WORLDS, len(self.motions))
        free = [0] * self.worlds  # period in which each world ends its last motion
        self._places: list[tuple[int, int]] = []
        self.starts: dict[int, dict[int, Motion]] = {}
        for motion in self.motions:
            world = int(np.argmin(free))
            self._places.append((free[world], world))
            self.starts.setdefault(free[world], {})[world] = motion
            free[world] += len(motion["ctrl"]) - 1
        self.ctrl = np.zeros((max(free), self.worlds, len(self.names)))
        for (row, world), motion in zip(self._places, self.motions, strict=True):
            self.ctrl[row:, world] = motion["ctrl"][-1]
            self.ctrl[row : row + len(motion["ctrl"]) - 1, world] = motion["ctrl"][:-1]

    def run(
        self, start: Callable[[dict[int, Motion], Any], None], step: Callable[[Any], Any]
    ) -> Any:
        """Play all motions; return positions after each period, (T, worlds, n) rad.

        Args:
            start: Puts worlds into the first states of motions, under commands (worlds, n) rad.
            step: Simulates one control period under commands (worlds, n) rad; returns positions
                (worlds, n) rad.
        """
        path = []
        for row, ctrl in enumerate(self.ctrl):
            if row in self.starts:
                start(self.starts[row], ctrl)
            path.append(step(ctrl))
        return np.array(path)

    def report(self, engine: str, path: Any, form: str = "plain") -> None:
        """Print the mean error of corrected joints beside gaponet's.

        Args:
            path: Positions after each period, (T, worlds, n) rad.
            form: Form of the robot that was played, a key of error_mrad in facts.json.
        """
        paths = []
        for (row, world), motion in zip(self._places, self.motions, strict=True):
            end = row + len(motion["qpos"]) - 1
            paths.append(np.asarray(path)[row:end, world])
        self.report_motions(f"{engine}, {self.worlds} worlds", paths, form)

    def report_motions(self, engine: str, paths: list[Any], form: str = "plain") -> None:
        """Print the same for motions played one by one.

        Args:
            paths: Positions after each period, (T, n) rad each.
        """
        columns = [self.names.index(name) for name in self.facts["corrected"]]
        pairs = zip(paths, self.motions, strict=True)
        errors = [np.abs(path - motion["qpos"][1:])[:, columns].mean() for path, motion in pairs]
        expected = self.facts["error_mrad"][form]
        print(f"{engine}: {1e3 * np.mean(errors):.2f} mrad; in gaponet {expected:.2f}")
