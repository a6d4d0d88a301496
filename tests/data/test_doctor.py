"""The doctor finds what is wrong with a recording, says it in words, and finds nothing wrong with a
good one.
"""

import json
import re
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from arm import TOML, XML, recordings, write_arm, write_dataset
from logs import arm_columns, arm_sequence, late, table_text, wave
from strange_logs import write_bag

from gaponet.base.errors import DatasetError, WorkerError
from gaponet.data.checks.timing import MIN_EARLY_RATIO, clock_drift
from gaponet.data.doctor import DoctorResult
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.data.sequence import Sequence
from gaponet.data.signals import Response, lowpass
from gaponet.data.store import Dataset
from gaponet.robot.finding import Finding
from gaponet.sim.dynamics import gravity_of, static_torque
from gaponet.sim.model import build_model

ROWS = 600
FAST = {"amplitude": 0.4, "hertz": 0.4}  # about 1 rad/s


def good(rows: int = ROWS, lag: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Command and state of two joints, the state three periods of 20 ms late."""
    ctrl = wave(rows, 2, 0.02, **FAST)
    return ctrl, late(ctrl, lag)


def examine(arm, tmp_path, *sequences) -> DoctorResult:
    dataset = Dataset.create(tmp_path / "data", arm)
    for sequence in sequences:
        dataset.append(sequence)
    return DoctorResult.of(dataset, arm)


def found(diagnosis: DoctorResult, check: str, level: str) -> Finding:
    """The one finding of a check at a level."""
    (finding,) = [f for f in diagnosis.findings if (f.check, f.level) == (check, level)]
    return finding


def test_a_good_recording_has_no_warning(arm, tmp_path):
    diagnosis = examine(arm, tmp_path, arm_sequence(arm, *good(), tau=wave(ROWS, 2)))
    assert [f for f in diagnosis.findings if f.level in ("warning", "error")] == []
    assert diagnosis.verdict == "Good: no error and no warning."


def test_torque_and_velocity_of_coarse_sensors_are_no_fault(arm, tmp_path):
    """A current register in steps, and an encoder of 12 bits at 500 Hz."""
    rows = 10_000
    dt = 0.002
    angle = 2 * np.pi * 0.1 * dt * np.arange(rows)[:, None] + np.array([0.0, 1.0])
    qpos = 0.2 * np.sin(angle)
    qvel = 0.2 * 2 * np.pi * 0.1 * np.cos(angle)
    encoder_step = 2 * np.pi / 4096
    quantised = np.round(late(qpos, 30) / encoder_step) * encoder_step
    tau = np.round(1.2 * np.sin(angle) / 0.05) * 0.05
    sequence = replace(arm_sequence(arm, qpos, quantised, qvel=late(qvel, 30), tau=tau), dt=dt)
    texts = [f.text for f in examine(arm, tmp_path, sequence).findings if f.level == "warning"]
    assert not [text for text in texts if "cut off flat" in text or "not rad/s" in text]


def test_findings_stand_worst_first(arm, tmp_path):
    ctrl, qpos = good()
    levels = [f.level for f in examine(arm, tmp_path, arm_sequence(arm, ctrl, -qpos)).findings]
    assert levels == sorted(levels, key=["error", "warning", "note", "ok"].index)
    assert levels[0] == "error"


def at(values, rows, new, joint=slice(None)):
    """The values with other ones in some rows of a joint."""
    values = values.copy()
    values[rows, joint] = new
    return values


DEGREES, ELBOW, BEYOND = np.array([1, 57.3]), np.array([1, -1]), np.array([1.2, 0])
SPIKY = at(at(0.3 * wave(ROWS, 2), 100, 4.5, 1), slice(300, 302), -3.0, 0)
SLOW = wave(ROWS, 2, 0.02, amplitude=0.4, hertz=0.05)
# What a recording holds instead of command u and state q; check, level and words of the finding.
FAULTS = {
    "mirrored": (
        lambda u, q: {"qpos": q * ELBOW},
        "sign",
        "error",
        "elbow moves against its command",
    ),
    "degrees": (
        lambda u, q: {"qpos": q * DEGREES},
        "unit",
        "error",
        "elbow moves 57.3 times as far as commanded",
    ),
    "a command in rad, read as degrees": (
        lambda u, q: {"ctrl": u / DEGREES},
        "unit",
        "error",
        "elbow moves 57.3 times as far as commanded",
    ),
    "velocity in degrees": (
        lambda u, q: {"qvel": np.gradient(q, 0.02, axis=0) * DEGREES},
        "unit",
        "warning",
        "recorded velocity of elbow is 57.3 times the derivative of its position",
    ),
    "another scale": (
        lambda u, q: {"qpos": q * [1, 1.3]},
        "unit",
        "warning",
        "elbow goes 1.30 rad where its command goes 1 rad: another scale",
    ),
    "the state as command": (
        lambda u, q: {"ctrl": q},
        "copied",
        "error",
        "command and state of shoulder, elbow are the same numbers in m: one was logged as both",
    ),
    "the next position as command": (
        lambda u, q: {"ctrl": np.roll(q, -1, axis=0)},
        "copied",
        "error",
        "the command of shoulder, elbow is the recorded position 1 row later",
    ),
    "the last command as position": (
        lambda u, q: {"qpos": np.roll(u, 1, axis=0)},
        "copied",
        "error",
        "the command of shoulder, elbow is the recorded position 1 row later",
    ),
    "the coming command as position": (
        lambda u, q: {"qpos": np.roll(u, -2, axis=0)},
        "copied",
        "error",
        "the position of shoulder, elbow is the command 2 rows later",
    ),
    "velocities as commands": (
        lambda u, q: {"ctrl": np.gradient(u, 0.02, axis=0)},
        "command",
        "error",
        "no position targets; they are most like velocities",
    ),
    "one sample off": (
        lambda u, q: {"qpos": at(q, 200, q[200, 1] + 1.0, 1)},
        "jumps",
        "warning",
        "elbow jumps and comes back faster than any motor in 3 rows of m",
    ),
    "beyond the range": (
        lambda u, q: {"ctrl": u + BEYOND, "qpos": q + BEYOND},
        "range",
        "warning",
        "the simulator clips there",
    ),
    "does not move": (
        lambda u, q: {"qpos": q * [1, 0]},
        "stuck",
        "error",
        "elbow does not move when commanded in m: unplugged, torque off or not read",
    ),
    "repeats itself": (
        lambda u, q: {
            "qpos": at(q, slice(100, 121), q[100]),
            "qvel": at(q, slice(100, 121), q[100]),
        },
        "stuck",
        "warning",
        "the whole state repeats itself for up to 0.40 s",
    ),
    "never commanded": (
        lambda u, q: {"ctrl": u * [1, 0], "qpos": q * [1, 0]},
        "order",
        "warning",
        "no motion commands elbow",
    ),
    "runs into a stop": (
        lambda u, q: {"qpos": np.minimum(q, [0.1, 9])},
        "blocked",
        "warning",
        "shoulder stood at 0.10 rad for",
    ),
    "slow": (
        lambda u, q: {"ctrl": SLOW, "qpos": late(SLOW, 3)},
        "lag",
        "note",
        "nothing is commanded faster than 0.3 rad/s",
    ),
    "unsigned torque": (
        lambda u, q: {"tau": np.abs(wave(ROWS, 2))},
        "torque",
        "warning",
        "torque is unsigned (never negative",
    ),
    "torque spikes": (
        lambda u, q: {"tau": SPIKY},
        "torque",
        "warning",
        "torque spikes: 3 samples in m; worst 4.50 N·m on elbow in m",
    ),
    "torque beyond the limit": (
        lambda u, q: {"tau": np.clip(40 * wave(ROWS, 2), -9, 9)},
        "saturation",
        "warning",
        "worst 9.00 N·m on shoulder (limit 5.00)",
    ),
    "constant torque": (
        lambda u, q: {"tau": np.zeros((ROWS, 2))},
        "torque",
        "warning",
        "torque of shoulder, elbow never changes; ignore it",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_in_one_recording_is_found_and_named(arm, tmp_path, fault):
    ctrl, qpos = good()
    change, check, level, words = FAULTS[fault]
    recorded = {"ctrl": ctrl, "qpos": qpos} | change(ctrl, qpos)
    diagnosis = examine(
        arm, tmp_path, arm_sequence(arm, recorded.pop("ctrl"), recorded.pop("qpos"), **recorded)
    )
    assert words in found(diagnosis, check, level).message


def test_every_joint_of_another_scale_is_named(arm, tmp_path):
    ctrl, qpos = good()
    diagnosis = examine(arm, tmp_path, arm_sequence(arm, ctrl, 1.3 * qpos))
    scales = [f.joints for f in diagnosis.findings if f.check == "unit" and "slope" in f.values]
    assert scales == [("shoulder",), ("elbow",)]


def test_swapped_joints_are_an_error(arm, tmp_path):
    ctrl, qpos = good()
    diagnosis = examine(arm, tmp_path, arm_sequence(arm, ctrl, qpos[:, ::-1]))
    texts = [f.message for f in diagnosis.findings if f.check == "order" and f.level == "error"]
    assert len(texts) == 2
    assert texts[0].startswith(
        "the command of shoulder moves elbow, not shoulder (correlation 1.00, 1 of 1 motions)"
    )
    assert '[columns] "ctrl.elbow" =' in texts[0]
    assert diagnosis.verdict.startswith("Do not train on this yet: 2 errors")


def test_columns_in_a_wrong_order_are_named_one_by_one_without_what_follows_from_them(
    so101, tmp_path
):
    rng = np.random.default_rng(0)
    logs = []
    for motion in ("a", "b", "c"):
        ctrl = lowpass(np.repeat(rng.uniform(-0.5, 0.5, (30, 6)), 30, axis=0), 0.02, 1.0)
        qpos = late(ctrl, 4)[:, [2, 0, 1, 3, 4, 5]]
        logs.append(arm_sequence(so101, ctrl, qpos, motion=motion))
    bad = [f for f in examine(so101, tmp_path, *logs).findings if f.level in ("warning", "error")]
    assert [f.check for f in bad if f.level == "error"] == ["order"] * 3
    assert not {f.check for f in bad} & {"stuck", "blocked"}
    assert "name the command's columns in logs.toml ([columns] \"ctrl." in bad[0].message


def test_radians_beside_logs_in_degrees_are_an_error(arm, tmp_path):
    ctrl, qpos = good()
    notes = {"notes": {"converted_from": dict.fromkeys(arm.joint_names, "deg")}}
    small = np.radians(1)
    logs = [
        arm_sequence(arm, ctrl, qpos, "right", **notes),
        arm_sequence(arm, ctrl * small, qpos * small, "w", **notes),
    ]
    finding = found(examine(arm, tmp_path, *logs), "unit", "error")
    assert finding.message.startswith(
        "no command of w is further than 3.3° from zero: radians that were read as degrees"
    )


def test_two_joints_told_the_same_are_not_taken_for_swapped(arm, tmp_path):
    ctrl = np.repeat(wave(ROWS, 1, 0.02, **FAST), 2, axis=1)
    assert found(examine(arm, tmp_path, arm_sequence(arm, ctrl, late(ctrl, 3))), "order", "ok")


def test_a_state_that_comes_before_its_command_is_an_error(arm, tmp_path):
    ctrl, qpos = good()
    diagnosis = examine(arm, tmp_path, arm_sequence(arm, qpos, ctrl))
    said = [f.message for f in diagnosis.findings if (f.check, f.level) == ("copied", "error")]
    assert re.match(
        r"shoulder moves 6\d ms before its command in 1 of 1 motions: are command and", said[0]
    )


def lively(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Commands that jump and wander, and a state that follows them as a servo with inertia does."""
    rng = np.random.default_rng(seed)
    ctrl = np.repeat(rng.uniform(-0.5, 0.5, (30, 2)), 30, axis=0)
    return ctrl, late(lowpass(ctrl, 0.02, 4.0), 4)


def five_logs(arm, change=lambda number, qpos: qpos):
    """Logs m0 to m4, whose states are changed by change(number, state)."""
    logs = []
    for number in range(5):
        ctrl, qpos = lively(number)
        logs.append(arm_sequence(arm, ctrl, change(number, qpos), motion=f"m{number}"))
    return logs


def of_a_fast_clock(number, qpos):
    """The state by a clock that is faster than the commands' by 3 in 1000."""
    rows = np.arange(len(qpos))
    return np.stack([np.interp(rows * 1.003, rows, column) for column in qpos.T], axis=1)


def of_one_late_recording(number, qpos):
    return late(qpos, 3) if number == 2 else qpos


@pytest.mark.parametrize("others", [0.0200001, 0.01], ids=["a measured rate", "another rate"])
def test_recordings_are_compared_that_have_nearly_the_same_rate(arm, tmp_path, others):
    """Each clock has a period of its own, and a dataset may hold two rates."""
    logs = [
        replace(one, dt=0.02 + 1e-7 * k)
        for k, one in enumerate(five_logs(arm, of_one_late_recording))
    ]
    for k in range(6):
        ctrl, qpos = lively(10 + k)
        logs.append(replace(arm_sequence(arm, ctrl, qpos, motion=f"n{k}"), dt=others))
    diagnosis = examine(arm, tmp_path, *logs)
    bad = [f for f in diagnosis.findings if f.level in ("warning", "error")]
    assert any("m2 (a, 0 kg) follows its commands" in f.message for f in bad)


def test_times_that_belong_together_are_left_alone(arm, tmp_path):
    diagnosis = examine(arm, tmp_path, *five_logs(arm))
    warned = {f.check for f in diagnosis.findings if f.level in ("warning", "error")}
    assert not warned & {"clock", "lag", "copied", "averaged"}


@pytest.mark.parametrize(
    ("odd", "check", "words"),
    [
        (of_a_fast_clock, "clock", "each recording follows its commands sooner"),
        (of_one_late_recording, "lag", "m2 (a, 0 kg) follows its commands"),
    ],
    ids=["clocks that drift", "one late recording"],
)
def test_times_that_do_not_belong_together_are_found(arm, tmp_path, odd, check, words):
    diagnosis = examine(arm, tmp_path, *five_logs(arm, odd))
    bad = [f for f in diagnosis.findings if f.level in ("warning", "error")]
    assert any(words in f.message for f in bad if f.check == check)


@pytest.mark.parametrize(("middle", "told"), [(0.5, True), (2.5, False)], ids=["drift", "jumps"])
def test_a_clock_that_drifts_is_late_by_half_in_the_middle_and_motions_that_differ_are_no_drift(
    middle, told
):
    """A trajectory generator follows quick parts of a motion later than slow ones, from one part to
    the next.
    """

    def surveys(duration):
        tracking = SimpleNamespace(response=SimpleNamespace(duration=duration))
        return [SimpleNamespace(tracking=tracking)] * 6

    end = 0.02 * np.array([0.7, 0.9, 1.0, 1.0, 1.1, 1.3])
    way = middle * np.array([1, -1, 1, -1, 1, -1]) if middle > 1 else middle
    shifts = np.stack([0 * end, way * end, end], axis=1)
    assert [f.check for f in clock_drift(surveys(12.0), shifts)] == ["clock"] * told
    assert not list(clock_drift(surveys(5.0), shifts))


@pytest.mark.parametrize(("ahead", "said"), [(0, False), (6, True)])
def test_commands_to_come_explain_states_only_where_states_come_first(ahead, said):
    logs = [lively(seed) for seed in range(4)]
    told = Response.common([Response.of(u[: len(u) - ahead], q[ahead:], 0.02) for u, q in logs])
    assert (told.early > MIN_EARLY_RATIO).tolist() == [said] * 2
    assert (told.onset < 0).tolist() == [said] * 2


@pytest.mark.parametrize("where", ["state", "command", "first rows of the state"])
def test_rows_of_zeros_are_a_warning(arm, tmp_path, where):
    ctrl, qpos = (x + 0.1 for x in good())
    rows = slice(0, 3) if "first" in where else slice(200, 203)
    (ctrl if where == "command" else qpos)[rows] = 0
    diagnosis = examine(arm, tmp_path, arm_sequence(arm, ctrl, qpos))
    said = [f.message for f in diagnosis.findings if (f.check, f.level) == ("jumps", "warning")]
    assert said[-1].startswith("all joints are exactly 0 for 3 rows of m")


def test_steps_from_and_to_zero_are_no_rows_of_zeros(arm, tmp_path):
    ctrl = np.repeat(((np.arange(ROWS) // 50) % 2 * 0.3)[:, None], 2, axis=1)
    assert found(
        examine(arm, tmp_path, arm_sequence(arm, ctrl, late(lowpass(ctrl, 0.02, 2.0), 3))),
        "jumps",
        "ok",
    )


def hanging(arm, payload: float = 0.0, shoulder: float = 0.0) -> Sequence:
    """The arm of tests/arm.py moved slowly about an angle of the shoulder, rad, with the torques
    that hold it up and a little friction.
    """
    ctrl = wave(ROWS, 2, 0.02, amplitude=0.8, hertz=0.05) + np.array([shoulder, 0.0])
    qpos = late(ctrl, 3)
    friction = 0.05 * np.sign(np.gradient(qpos, axis=0))
    tau = static_torque(build_model(arm, payload), qpos) + friction
    return arm_sequence(arm, ctrl, qpos, payload=payload, tau=tau)


def weigh(arm, tmp_path, *sequences) -> DoctorResult:
    dataset = Dataset.create(tmp_path / "data", arm)
    for sequence in sequences:
        dataset.append(sequence)
    return DoctorResult.of(
        dataset,
        arm,
        gravity_model=lambda qpos, mass, side: static_torque(build_model(arm, mass, side), qpos),
    )


@pytest.mark.parametrize("payload", [0.0, 0.2])
def test_torques_that_hold_up_the_arm_as_logged_are_fine(arm, tmp_path, payload):
    diagnosis = weigh(arm, tmp_path, hanging(arm, payload))
    assert found(diagnosis, "gravity", "ok")
    assert diagnosis.verdict.startswith("Good")


def test_few_torques_and_rests_say_nothing_about_gravity(arm, tmp_path):
    short = arm_sequence(arm, wave(40, 2), late(wave(40, 2), 3))
    assert (
        "too few torques and rests" in found(weigh(arm, tmp_path, short), "gravity", "ok").message
    )


@pytest.mark.parametrize(("joint", "turn"), [(0, 0.6), (1, 0.8), (0, -1.2)])
def test_a_zero_wrong_in_command_and_state_alike_shows_in_the_torque(arm, tmp_path, joint, turn):
    s, shift = hanging(arm), turn * np.eye(2)[joint]
    finding = found(
        weigh(arm, tmp_path, replace(s, ctrl=s.ctrl + shift, qpos=s.qpos + shift)),
        "gravity",
        "warning",
    )
    assert finding.joints == (arm.joint_names[joint],)
    assert finding.message.startswith("with its zero turned by")


def test_a_sign_wrong_in_command_and_state_alike_shows_in_the_torque(arm, tmp_path):
    s, sign = hanging(arm), np.array([1, -1])
    wrong = replace(s, ctrl=s.ctrl * sign, qpos=s.qpos * sign, qvel=s.qvel * sign)
    finding = found(weigh(arm, tmp_path, wrong), "gravity", "warning")
    assert finding.message.startswith("with its angle mirrored at")


def test_a_robot_that_hangs_from_the_ceiling_is_told_from_a_joint_with_a_wrong_zero(tmp_path):
    upright = 'integrator="implicitfast"'
    hung = XML.replace(upright, f'{upright} gravity="0 0 9.81"')
    recorded = hanging(write_arm(tmp_path / "hung", xml=hung), shoulder=1.2)
    arm = write_arm(tmp_path / "arm")
    finding = found(weigh(arm, tmp_path, recorded), "gravity", "warning")
    assert "the base hangs upside down" in finding.message
    assert not finding.mend


def test_gravity_is_judged_without_a_known_torque_limit(tmp_path):
    arm = write_arm(tmp_path / "arm", TOML.replace("effort_limit = 5.0", "effort_limit = 1e6"))
    s, shift = hanging(arm), 0.6 * np.eye(2)[0]
    wrong = replace(s, ctrl=s.ctrl + shift, qpos=s.qpos + shift)
    assert found(weigh(arm, tmp_path, wrong), "gravity", "warning").joints == ("shoulder",)


def test_an_arm_that_gravity_does_not_load_shows_no_zeros(tmp_path):
    arm = write_arm(tmp_path / "arm", xml=XML.replace("<option ", '<option gravity="0 0 0" '))
    finding = found(weigh(arm, tmp_path, hanging(arm)), "gravity", "ok")
    assert finding.message.startswith("gravity loads no joint here")


def standing(arm, seed: int, share: float, behind_gears: bool = False) -> Sequence:
    """The simulated arm moved from hold to hold, with a share of its weight fed forward, and the
    motors' torque.

    Args:
        behind_gears: The torque is measured behind the friction.
    """
    model, rng = build_model(arm), np.random.default_rng(seed)
    data, rows = mujoco.MjData(model), []
    for ctrl in lowpass(np.repeat(rng.uniform(-1.2, 1.2, (8, 2)), 75, axis=0), 0.02, 4.0).round(3):
        fed = share * data.qfrc_bias
        data.ctrl[:], data.qfrc_applied[:] = ctrl, fed
        friction = data.qfrc_constraint if behind_gears else 0.0
        rows.append((ctrl, data.qpos.copy(), data.actuator_force + fed + friction))
        mujoco.mj_step(model, data, arm.decimation)
    ctrl, qpos, tau = np.array(rows).swapaxes(0, 1)
    noise = 3e-4 * rng.standard_normal((2, *qpos.shape))
    return arm_sequence(arm, ctrl, qpos + noise[0], f"m{seed}", tau=tau + 10 * noise[1])


@pytest.mark.parametrize(
    ("share", "behind_gears", "level"),
    [(0.0, False, "ok"), (0.0, True, "ok"), (0.5, False, "warning"), (1.0, False, "warning")],
)
def test_a_torque_fed_forward_beside_the_command_is_told_from_a_servo_that_sags(
    arm, tmp_path, share, behind_gears, level
):
    data = write_dataset(
        tmp_path / "data", arm, [standing(arm, seed, share, behind_gears) for seed in range(4)]
    )
    diagnosis = DoctorResult.of(data, arm, gravity_model=gravity_of(arm))
    finding = found(diagnosis, "feed-forward", level)
    if level == "ok":
        assert finding.message == "no torque beside the commands is seen at rest"
        return
    assert finding.joints == arm.joint_names
    assert list(finding.values.values()) == pytest.approx([share, share], abs=0.05)
    assert not any(
        f.check in ("rests", "gains", "offset") for f in diagnosis.findings
    )  # the missing sag is its effect


def test_a_few_rests_do_not_tell_what_holds_the_arm(arm, tmp_path):
    data = write_dataset(tmp_path / "data", arm, [standing(arm, 0, 1.0)])
    finding = found(DoctorResult.of(data, arm, gravity_model=gravity_of(arm)), "feed-forward", "ok")
    assert "too few rests with torque" in finding.message


def test_a_motor_too_weak_for_its_load_is_no_error_of_the_commands(arm, tmp_path):
    """Servos that move with their commands, far from them: those of four pendulums on an XL330
    did.
    """
    ctrl, _ = good()
    weak = late(0.3 * ctrl, 3) - 0.5
    finding = found(examine(arm, tmp_path, arm_sequence(arm, ctrl, weak)), "command", "warning")
    assert "though they move with them: motors too weak for their load" in finding.message


def sampled(values, step, times):
    """Columns of values (T, n) that stand `step` s apart, at other times, s."""
    clock = step * np.arange(len(values))
    return np.stack([np.interp(times, clock, column) for column in values.T], axis=1)


def slow_rows(arm, times, rng):
    """A log's columns with rows at these times, s: commands hold for 20 ms, states are 60 ms
    late.
    """
    step = 0.005
    targets = np.repeat(rng.uniform(-1, 1, (40, 2)), 200, axis=0)
    ctrl = lowpass(targets, step, 0.8)
    held = sampled(ctrl, step, np.floor(times / 0.02) * 0.02)
    state = sampled(ctrl, step, times - 0.06)
    columns = {"time": times}
    for i, joint in enumerate(arm.joint_names):
        columns[f"ctrl.{joint}"] = held[:, i]
        columns[f"qpos.{joint}"] = state[:, i]
    return columns


@pytest.mark.parametrize("rows", ["uniform 12 to 40 Hz", "slower and slower"])
def test_rows_at_12_to_40_hz_are_no_error_of_clocks_and_say_which_times_are_not_known(
    arm, tmp_path, rows
):
    folder = tmp_path / "logs"
    folder.mkdir()
    for seed in range(4):
        rng = np.random.default_rng(seed)
        rates = np.linspace(40, 12, 700)
        if rows.startswith("uniform"):
            rates = rng.uniform(12, 40, 700)
        columns = slow_rows(arm, np.cumsum(1 / rates), rng)
        (folder / f"m{seed}.csv").write_text(table_text(columns))
    request = ImportRequest(unit_id="a", payload_mass=0.0, position_unit="rad", time_unit="s")
    data = import_logs(folder, arm, tmp_path / "data", request).dataset
    assert "apart, and shorter delays are not known" in data.entries[0].meta.notes["why_resampled"]
    diagnosis = DoctorResult.of(data, arm)
    messages = []
    for finding in diagnosis.findings:
        if finding.level == "error" or finding.check in ("copied", "averaged"):
            messages.append(finding.message)
    assert messages == ["no state comes before its command"]
    assert "cannot be told between such rows" in found(diagnosis, "jitter", "warning").message


def test_a_load_that_sags_far_is_not_taken_for_a_stop(arm, tmp_path):
    ctrl, qpos = good()
    hold = np.repeat(ctrl[-1:], 200, axis=0)
    sequence = arm_sequence(arm, np.concatenate([ctrl, hold]), np.concatenate([qpos, hold]) + 0.25)
    assert found(examine(arm, tmp_path, sequence), "blocked", "ok")


def test_missing_samples_and_jitter_are_reported_from_the_logs_own_clock(arm, tmp_path):
    notes = {
        "rate_hz": 50.0,
        "jitter_ms": 80.0,
        "longest_gap_ms": 100.0,
        "rows": "resampled to 50.00 Hz",
    }
    diagnosis = examine(arm, tmp_path, arm_sequence(arm, *good(), notes=notes))
    assert found(diagnosis, "gaps", "warning").message.startswith(
        "1 sequence(s) miss samples, at worst 100 ms (m)"
    )
    assert found(diagnosis, "jitter", "warning").values == {"jitter_ms": 80.0}
    assert found(diagnosis, "rate", "note").message == "1 sequence(s) were put on a uniform grid: m"


class DyingExecutor(Executor):
    """An executor whose workers are killed."""

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        future.set_exception(BrokenProcessPool("killed"))
        return future


def test_other_processes_measure_the_same_and_workers_that_die_are_an_error(arm, tmp_path):
    dataset = Dataset.create(tmp_path / "data", arm)
    for sequence in recordings(arm, 3, rows=ROWS):
        dataset.append(sequence)
    with ProcessPoolExecutor(2, get_context("spawn")) as processes:
        there = DoctorResult.of(dataset, arm, executor=processes).to_dict()
    assert json.dumps(there) == json.dumps(DoctorResult.of(dataset, arm).to_dict())
    with pytest.raises(WorkerError, match="died"):
        DoctorResult.of(dataset, arm, executor=DyingExecutor())


def test_two_rates_in_one_dataset_are_a_warning(arm, tmp_path):
    first = arm_sequence(arm, *good())
    second = replace(arm_sequence(arm, *good(lag=2)), dt=0.01)
    message = found(examine(arm, tmp_path, first, second), "rate", "warning").message
    assert message.startswith("1 at 50.00 Hz (20.00 ms), 1 at 100.00 Hz (10.00 ms)")


def test_a_lag_of_three_periods_is_reported_as_60_ms(arm, tmp_path):
    finding = found(examine(arm, tmp_path, arm_sequence(arm, *good(lag=3))), "lag", "note")
    assert finding.values["elbow"]["median"] == pytest.approx(0.06, abs=0.003)
    assert "after 60 ms" in finding.message


def test_sag_is_reported_for_the_lightest_and_the_heaviest_payload(arm, tmp_path):
    ctrl, qpos = good()
    still = np.repeat(ctrl[-1:], 60, axis=0)
    rest = lambda sag: (  # noqa: E731
        np.concatenate([ctrl, still]),
        np.concatenate([qpos, still + np.array([sag, 0])]),
    )
    sequences = [
        arm_sequence(arm, *rest(0.03 + 0.1 * mass), payload=mass) for mass in (0.0, 0.5, 1.0)
    ]
    finding = found(examine(arm, tmp_path, *sequences), "sag", "note")
    assert finding.joints == ("shoulder",)
    assert "shoulder +30" in finding.message
    assert "shoulder +130" in finding.message
    assert "0.5 kg" not in finding.message


def test_one_recording_under_two_payloads_is_an_error(arm, tmp_path):
    sequence = arm_sequence(arm, *good())
    other = replace(sequence, meta=replace(sequence.meta, payload_mass=1.0))
    assert "m-a-0kg" in found(examine(arm, tmp_path, sequence, other), "labels", "error").message


def test_an_empty_dataset_and_another_robot_are_refused(arm, so101, tmp_path):
    dataset = Dataset.create(tmp_path / "data", arm)
    with pytest.raises(DatasetError, match="sequences"):
        DoctorResult.of(dataset, arm)
    with pytest.raises(DatasetError, match="'arm'"):
        DoctorResult.of(dataset, so101)


def test_the_inventory_counts_units_payloads_and_minutes(arm, tmp_path):
    dataset = Dataset.create(tmp_path / "data", arm)
    dataset.append(arm_sequence(arm, *good()))
    dataset.append(arm_sequence(arm, *good(), payload=1.5, unit="b"))
    assert (
        DoctorResult.inventory(dataset)
        == "2 recordings, 1 motions, 0.4 min; units a, b; payloads 0, 1.5 kg"
    )


@pytest.fixture(scope="module")
def real_diagnosis(real_dataset, so101) -> DoctorResult:
    return DoctorResult.of(real_dataset, so101, gravity_model=gravity_of(so101))


def test_real_so101_logs_are_usable(real_diagnosis):
    assert real_diagnosis.verdict == "Usable. Read the 3 warnings first."


def test_real_so101_logs_show_their_lag(real_diagnosis, so101):
    lags = found(real_diagnosis, "lag", "note").values
    for joint in so101.operated:
        assert 0.08 <= lags[joint]["median"] <= 0.16
        assert 0.07 <= lags[joint]["min"] <= lags[joint]["max"] <= 0.16


def test_real_so101_logs_show_their_sag(real_diagnosis):
    assert found(real_diagnosis, "sag", "note").joints == ("shoulder_lift", "elbow_flex")


def test_real_so101_logs_show_the_unit_of_their_gripper(real_diagnosis):
    message = found(real_diagnosis, "unit", "note").message
    assert message.startswith("gripper is logged as 0..1, not in rad")


def test_real_so101_logs_show_what_their_torque_is(real_diagnosis):
    torque = [f.message for f in real_diagnosis.findings if f.check == "torque"]
    assert torque[0].startswith("torque is unsigned")
    assert torque[1].startswith("torque spikes")


def test_real_so101_logs_show_their_rate(real_diagnosis):
    assert {row["rate_hz"] for row in real_diagnosis.sequences} == {49.85}


def test_real_so101_logs_show_the_joint_that_was_blocked(real_diagnosis):
    assert found(real_diagnosis, "blocked", "warning").joints == ("wrist_roll",)


def read(arm, tmp_path, columns, **more) -> DoctorResult:
    """The diagnosis of one recording that is imported from a table."""
    logs = tmp_path / "m.csv"
    logs.write_text(table_text(columns).replace("nan", ""))
    units = {"position_unit": "rad", "time_unit": "s"} | more
    request = ImportRequest(unit_id="a", payload_mass=0.0, **units)
    return DoctorResult.of(import_logs(logs, arm, tmp_path / "data", request).dataset, arm)


TORQUES = {"tau.shoulder": wave(ROWS, 2)[:, 0], "tau.elbow": wave(ROWS, 2)[:, 1]}


def test_a_channel_that_was_empty_is_noted(arm, tmp_path):
    empty = {name: np.full(ROWS, np.nan) for name in TORQUES}
    finding = found(read(arm, tmp_path, arm_columns(ROWS) | empty), "absent", "note")
    assert finding.joints == arm.joint_names


def test_a_command_slower_than_the_state_is_noted_as_held(arm, tmp_path):
    columns = arm_columns(ROWS)
    for joint in arm.joint_names:
        columns[f"ctrl.{joint}"][1::2] = np.nan
    assert "held" in found(read(arm, tmp_path, columns), "slower", "note").message


def test_rows_that_the_logger_wrote_twice_are_noted(arm, tmp_path):
    twice = {name: np.repeat(values, 2) for name, values in arm_columns(ROWS).items()}
    twice["time"][1::2] += 4e-4
    assert found(read(arm, tmp_path, twice), "repeated", "note").values == {"rows": ROWS}


def test_messages_that_a_bag_holds_twice_are_noted(arm, tmp_path):
    write_bag(tmp_path / "wave", twice=True)
    request = ImportRequest(unit_id="lab", payload_mass=0.0)
    import_logs(tmp_path / "wave", arm, tmp_path / "data", request)
    diagnosis = DoctorResult.of(Dataset(tmp_path / "data"), arm)
    assert found(diagnosis, "repeated", "note").values == {"rows": 40}


def test_a_torque_that_no_motor_has_is_a_warning(arm, tmp_path):
    torques = {name: values.copy() for name, values in TORQUES.items()}
    torques["tau.elbow"][100:103] = 1e9
    finding = found(read(arm, tmp_path, arm_columns(ROWS) | torques), "nonsense", "warning")
    assert (finding.joints, finding.values) == (("elbow",), {"rows": 3})


def test_many_rows_that_were_cut_are_a_warning(arm, tmp_path):
    columns = arm_columns(ROWS)
    columns["qpos.elbow"][100:130] = np.nan
    diagnosis = read(arm, tmp_path, columns, skip_bad=True)
    assert found(diagnosis, "cut", "warning").values == {"rows": 30}


@pytest.mark.parametrize(
    ("state", "word"),
    [
        (lambda q: q + 2 * np.pi, "moved"),
        (lambda q: (q + np.pi) % (2 * np.pi) - np.pi, "continued"),
    ],
    ids=["a turn away", "wrapped"],
)
def test_angles_that_import_turned_are_noted(tmp_path, state, word):
    free = 'name="shoulder" axis="0 1 0"'
    arm = write_arm(tmp_path / "arm", TOML, XML.replace(f'{free} range="-1.5 1.5"', free))
    columns = arm_columns(ROWS)
    for name in ("ctrl.shoulder", "qpos.shoulder"):  # on and on, by 2 rad/s
        columns[name] = columns[name] + 2 * columns["time"]
    columns["qpos.shoulder"] = state(columns["qpos.shoulder"])
    finding = found(read(arm, tmp_path, columns), "turns", "note")
    assert finding.joints == ("shoulder",)
    assert word in finding.message


def test_angles_that_were_counted_from_zero_are_noted(arm, tmp_path):
    """−0.9 to −0.3 rad are 308° to 343°."""
    columns = arm_columns(ROWS)
    for name in columns.keys() - {"time"}:
        columns[name] = np.degrees(columns[name])
        if "shoulder" in name:
            columns[name] = (columns[name] - np.degrees(0.6)) % 360
    finding = found(read(arm, tmp_path, columns, position_unit="deg"), "turns", "note")
    assert finding.joints == ("shoulder",)
    assert "range" in finding.message


@pytest.mark.parametrize(
    ("jitter_ms", "level"), [(1.0, "ok"), (5.0, "note"), (11.0, "warning")], ids=str
)
def test_jitter_is_judged_against_the_period_of_20_ms(arm, tmp_path, jitter_ms, level):
    notes = {"rate_hz": 50.0, "jitter_ms": jitter_ms}
    diagnosis = examine(arm, tmp_path, arm_sequence(arm, *good(), notes=notes))
    assert found(diagnosis, "jitter", level).values == {"jitter_ms": jitter_ms}


def test_a_robot_that_stands_while_all_its_commands_move_on_was_stopped(arm, tmp_path):
    ctrl, qpos = good()
    stood = 100  # rows, 2 s
    qpos[300 : 300 + stood] = qpos[300]
    qpos += 1e-5 * np.random.default_rng(0).standard_normal(qpos.shape)
    finding = found(examine(arm, tmp_path, arm_sequence(arm, ctrl, qpos)), "stop", "warning")
    assert finding.values["seconds"] == pytest.approx(2.0, abs=0.3)


def test_one_joint_in_steps_57_times_as_coarse_as_the_others_is_in_degrees(so101, tmp_path):
    step = np.full(6, 1e-3)
    step[2] = np.degrees(1e-3)
    ctrl = np.where(step > 0.01, 0.5, 0.05) * wave(ROWS, 6, 0.02, amplitude=1.0)
    qpos = np.round(late(ctrl, 3) / step) * step
    diagnosis = examine(so101, tmp_path, arm_sequence(so101, ctrl, qpos))
    units = [f.joints for f in diagnosis.findings if (f.check, f.level) == ("unit", "warning")]
    assert ("elbow_flex",) in units


def test_gains_that_differ_between_recordings_are_noted(arm, tmp_path):
    first = arm_sequence(arm, *good())
    second = arm_sequence(arm, *good(lag=2), motion="n")
    stiff = replace(second, meta=replace(second.meta, kp=(40.0, 40.0)))
    assert "kp" in found(examine(arm, tmp_path, first, stiff), "labels", "note").message


def test_commands_of_less_than_two_degrees_were_radians(arm, tmp_path):
    ctrl, qpos = (np.radians(values) for values in good())
    notes = {"converted_from": dict.fromkeys(arm.joint_names, "deg")}
    diagnosis = examine(arm, tmp_path, arm_sequence(arm, ctrl, qpos, notes=notes))
    assert "radians" in found(diagnosis, "unit", "warning").message
    assert "degrees" in found(diagnosis, "order", "warning").message


def test_an_error_and_warnings_are_both_counted(arm, tmp_path):
    ctrl, qpos = good()
    wrong = arm_sequence(arm, ctrl, qpos * ELBOW, tau=np.zeros((ROWS, 2)))
    assert "1 error and 1 warning" in examine(arm, tmp_path, wrong).verdict


def held(qpos: np.ndarray, mass: float, side: str) -> np.ndarray:
    """The torques that hold two links of 0.2 m up, of 0.3 and 0.2 kg, and a payload, (k, 2) N·m."""
    fore = 9.81 * (0.2 * 0.1 + mass * 0.2) * np.cos(qpos.sum(axis=1))
    upper = 9.81 * (0.3 * 0.1 + (0.2 + mass) * 0.2) * np.cos(qpos[:, 0])
    return np.stack([upper + fore, fore], axis=1)


def resting(arm, seed: int, payload: float = 0.0, label: float | None = None, soft: float = 1.0):
    """The arm going from hold to hold, sagging as its servos do under a payload that the label may
    not say.

    Args:
        soft: How many times as far as kp says.
    """
    rng = np.random.default_rng(seed)
    levels = rng.uniform(-1.2, 1.2, (8, 2))
    knots = 80 * np.arange(8)[:, None] + [0, 60]  # a rest of 60 rows, and 20 to the next
    rows = np.arange(knots.max())
    ctrl = np.stack([np.interp(rows, knots.ravel(), np.repeat(x, 2)) for x in levels.T], axis=1)
    told = late(ctrl, 3)
    qpos = told
    for _ in range(20):
        qpos = told - soft * held(qpos, payload, "hand") / arm.servo.kp
    noise = 3e-4 * rng.standard_normal(ctrl.shape)
    said = payload if label is None else label
    return arm_sequence(arm, ctrl, qpos + noise, f"m{seed}", said)


def at_rest(arm, tmp_path, logs) -> DoctorResult:
    data = write_dataset(tmp_path / "data", arm, logs)
    return DoctorResult.of(data, arm, gravity_model=held)


@pytest.mark.parametrize(("labels", "level"), [((0.0, 0.5), "ok"), ((0.5, 0.0), "warning")])
def test_payload_labels_in_each_others_place_are_found(arm, tmp_path, labels, level):
    logs = []
    for seed in range(6):
        payload = (0.0, 0.5)[seed % 2]
        logs.append(resting(arm, seed, payload, labels[seed % 2]))
    diagnosis = at_rest(arm, tmp_path, logs)
    if level == "ok":
        assert found(diagnosis, "rests", "ok")
        return
    finding = found(diagnosis, "payload", "warning")
    assert finding.values == {"labels": [0.0, 0.5], "rests_as": [0.5, 0.0]}


@pytest.mark.parametrize(("soft", "fed"), [(0.2, True), (3.0, False)])
def test_joints_that_do_not_sag_as_kp_says_are_found(arm, tmp_path, soft, fed):
    logs = [resting(arm, seed, 0.2, soft=soft) for seed in range(4)]
    finding = found(at_rest(arm, tmp_path, logs), "gains", "warning")
    assert finding.values["softness"]["shoulder"] == pytest.approx(soft, rel=0.1)
    assert ("feedforward" in finding.message) is fed


def test_recordings_of_two_robots_under_one_name_are_found(arm, tmp_path):
    """Zeros of three recordings lie 20 and −30 mrad apart from those of the others."""
    logs = []
    for seed in range(6):
        one = resting(arm, seed)
        shift = np.array([0.02, -0.03]) * (seed % 2)
        logs.append(replace(one, qpos=one.qpos + shift))
    finding = found(at_rest(arm, tmp_path, logs), "unit_id", "warning")
    assert finding.joints == arm.joint_names
    assert finding.values["apart"] == pytest.approx(0.03, abs=2e-3)
    assert finding.values["motions"] in (["m0", "m2", "m4"], ["m1", "m3", "m5"])


def test_a_robot_without_a_place_for_payloads_is_judged_by_its_own_weight(tmp_path):
    arm = write_arm(tmp_path / "arm", TOML.split("[[payload_mount]]")[0])
    data = write_dataset(tmp_path / "data", arm, [resting(arm, s, soft=3.0) for s in range(4)])

    def own_weight(qpos, mass, side):
        assert mass == 0
        return held(qpos, mass, side)

    finding = found(DoctorResult.of(data, arm, gravity_model=own_weight), "gains", "warning")
    assert finding.joints == ("shoulder",)  # the elbow sags by 10 mrad, too little to tell


def test_a_joint_that_follows_later_than_the_others_is_named(so101, tmp_path):
    logs = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        ctrl = np.repeat(rng.uniform(-0.5, 0.5, (30, 6)), 30, axis=0)
        qpos = late(lowpass(ctrl, 0.02, 4.0), 4)
        qpos[:, 2] = late(qpos[:, 2:3], 6)[:, 0]  # 120 ms more
        logs.append(arm_sequence(so101, ctrl, qpos, f"m{seed}"))
    finding = found(examine(so101, tmp_path, *logs), "lag", "warning")
    assert finding.joints == ("elbow_flex",)
    assert finding.values["extra_s"] == pytest.approx(0.12, abs=0.02)


def test_several_late_recordings_are_one_finding(arm, tmp_path):
    logs = []
    for seed in range(10):
        ctrl, qpos = lively(seed)
        if seed in (1, 4, 6, 8):
            qpos = late(qpos, 3)
        logs.append(arm_sequence(arm, ctrl, qpos, f"m{seed}"))
    finding = found(examine(arm, tmp_path, *logs), "lag", "warning")
    assert finding.values["late_s"] == pytest.approx([0.06] * 4, abs=0.02)
