"""ROS bags: two topics joined in time, whatever says the command, and clocks that do not agree."""

import numpy as np
import pytest

pytest.importorskip("rosbags")
from strange_logs import motion, write_bag

from gaponet.base.errors import LogError
from gaponet.data.formats import ReadOptions, detect, read_logs
from gaponet.data.importer import ImportRequest, import_logs

JOINTS = 'joints = ["shoulder", "elbow"]\n'


def only(path, arm):
    ((_, log),) = read_logs(path, arm)
    return log


@pytest.mark.parametrize("storage", ["mcap", "db3"])
def test_command_and_state_are_two_topics_with_clocks_of_their_own(tmp_path, arm, storage):
    bag = write_bag(tmp_path / "wave", storage)
    assert detect(tmp_path) == "rosbag"
    file = next(bag.glob(f"*.{storage}"))
    assert detect(file) == "rosbag"
    for path in (tmp_path, bag, file):
        log = only(path, arm)
        ctrl, qpos = motion()
        assert np.array_equal(log.channels["qpos"].values, qpos)
        assert np.array_equal(log.channels["ctrl"].values, ctrl[::2])
        assert log.channels["qpos"].time == pytest.approx(0.02 * np.arange(40), abs=1e-6)
        assert log.channels["ctrl"].time == pytest.approx(0.004 + 0.04 * np.arange(20), abs=1e-6)


def test_a_folders_whole_name_is_the_motion(tmp_path, arm):
    write_bag(tmp_path / "wave_0.2kg_1")
    (tmp_path / "logs.toml").write_text(f'{JOINTS}motion = "{{motion}}_{{payload:g}}kg_{{rep}}"\n')
    ((name, log),) = read_logs(tmp_path, arm)
    assert name == "wave"
    assert log.meta["stated"] == {"payload_mass": 0.2, "repetition": 1}


@pytest.mark.parametrize("command", ["trajectory", "array", "controller", "custom"])
def test_what_says_the_command_may_be_of_several_kinds(tmp_path, arm, command):
    bag = write_bag(tmp_path / "wave", command=command)
    (tmp_path / "logs.toml").write_text(JOINTS)
    log = only(tmp_path, arm)
    assert np.array_equal(log.channels["ctrl"].values, motion()[0][::2])
    assert bag.is_dir()


def test_points_that_are_to_be_reached_slowly_are_no_commands(tmp_path, arm):
    write_bag(tmp_path / "wave", command="trajectory", reached_in=0.5)
    (tmp_path / "logs.toml").write_text(JOINTS)
    with pytest.raises(LogError, match=r"reached in 0\.5 s.*controller_state"):
        only(tmp_path, arm)


def test_all_arrays_of_a_message_of_ones_own_are_offered(tmp_path, arm):
    write_bag(tmp_path / "wave", command="custom")
    (tmp_path / "logs.toml").write_text('ctrl = "/arm/commands.gain"\n')
    with pytest.raises(LogError, match=r"gains\[3\]"):
        only(tmp_path, arm)


def test_unitrees_low_level_messages_bring_their_gains(tmp_path, arm):
    write_bag(tmp_path / "wave", command="unitree")
    (tmp_path / "logs.toml").write_text('joints = ["shoulder", "elbow"' + 33 * ', ""' + "]\n")
    log = only(tmp_path, arm)
    assert np.allclose(log.channels["qpos"].values, motion()[1], atol=1e-6)
    assert np.allclose(log.channels["ctrl"].values, motion()[0][::2], atol=1e-6)
    assert (log.meta["kp"], log.meta["kd"]) == ([20.0, 20.0], [1.0, 1.0])
    assert "the recorder's" in log.meta["notes"]["clock"]["/arm/commands"]


def test_the_torque_in_unitrees_command_is_fed_forward(tmp_path, arm):
    write_bag(tmp_path / "wave", command="unitree", tau=3.0)
    (tmp_path / "logs.toml").write_text('joints = ["shoulder", "elbow"' + 33 * ', ""' + "]\n")
    made = import_logs(
        tmp_path, arm, tmp_path / "data", ImportRequest(unit_id="lab", payload_mass=0.0)
    ).dataset
    plain = only(tmp_path, arm).channels["ctrl"].values
    assert np.allclose(made.read(made.entries[0]).ctrl[::2], plain + 3.0 / 20.0, atol=1e-6)


def test_commands_are_held_and_states_interpolated_and_it_is_written_down(tmp_path, arm):
    write_bag(tmp_path / "logs" / "wave")
    (entry,) = import_logs(
        tmp_path / "logs", arm, tmp_path / "data", ImportRequest(unit_id="lab", payload_mass=0.0)
    ).entries
    assert entry.dt == pytest.approx(0.02)
    assert entry.meta.notes["rows"] == "resampled to 50.00 Hz: commands held, states interpolated"


@pytest.mark.parametrize(("drift", "away"), [(0.02, 0.0), (0.0, 3.0), (-0.01, -1e6)])
def test_a_command_clock_that_runs_away_is_brought_back_and_noted(tmp_path, arm, drift, away):
    write_bag(tmp_path / "wave", drift=drift, away=away)
    log = only(tmp_path, arm)
    state, command = log.channels["qpos"].time, log.channels["ctrl"].time
    assert command - state[::2] == pytest.approx(0.004 * np.ones(20), abs=2e-4)
    assert "ppm" in log.meta["notes"]["clock"]["/arm/commands"]


def test_clocks_that_agree_are_left_alone(tmp_path, arm):
    write_bag(tmp_path / "wave")
    assert "clock" not in only(tmp_path, arm).meta["notes"]


def test_messages_recorded_twice_count_once(tmp_path, arm):
    write_bag(tmp_path / "wave", twice=True)
    log = only(tmp_path, arm)
    assert len(log.channels["qpos"].time) == 40
    assert log.meta["notes"]["repeated"] == {"rows": 40}


def test_a_bag_without_commands_says_so_and_what_can_still_be_done(tmp_path, arm):
    write_bag(tmp_path / "wave", with_command=False)
    with pytest.raises(LogError, match=r"joint_states\.position\[2\]"):
        only(tmp_path, arm)


def test_a_bag_cut_short_is_one_clear_error(tmp_path, arm):
    bag = write_bag(tmp_path / "wave")
    file = next(bag.glob("*.mcap"))
    whole = file.read_bytes()
    for size in (0, 7, len(whole) // 2, len(whole) - 5):
        file.write_bytes(whole[:size])
        with pytest.raises(LogError, match="bag"):
            only(file, arm)


def write_joint_states(bag, messages):
    """A bag of JointStates, messages (topic, time s, names, position, effort), with stamps."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/JointState"
    make = lambda told, **fields: store.types[told](**fields)  # noqa: E731
    with Writer(bag, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic in sorted({message[0] for message in messages})
        }
        for topic, t, names, position, effort in messages:
            stamp = make("builtin_interfaces/msg/Time", sec=int(t), nanosec=round(t % 1 * 1e9))
            header = make("std_msgs/msg/Header", stamp=stamp, frame_id="")
            message = make(
                kind,
                header=header,
                name=names,
                position=np.array(position),
                velocity=np.array([]),
                effort=np.array(effort),
            )
            writer.write(topics[topic], round(t * 1e9), store.serialize_cdr(message, kind))
    return bag


@pytest.mark.parametrize("together", [True, False])
def test_publishers_of_some_joints_each_are_joined_by_name(tmp_path, arm, together):
    ctrl, qpos = motion()
    messages = []
    for i, time in enumerate(10 + 0.02 * np.arange(40)):
        later = time if together else time + 0.006
        messages += [
            ("/joint_states", time, ["shoulder"], qpos[i, :1], [np.nan]),
            ("/joint_states", later, ["elbow", "wheel"], [qpos[i, 1], 3.0], [np.nan, np.nan]),
            ("/joint_command", time + 0.001, ["elbow", "shoulder"], ctrl[i, ::-1], []),
        ]
    write_joint_states(tmp_path / "wave", messages)
    (tmp_path / "logs.toml").write_text('ignore = ["wheel"]\n')
    log = only(tmp_path, arm)
    assert "tau" not in log.channels
    assert np.array_equal(log.channels["ctrl"].values, ctrl)
    states = log.channels["qpos"]
    elbow = states.values[:, log.joint_names.index("elbow")]
    shoulder = states.values[:, log.joint_names.index("shoulder")]
    start = states.time[0] - (0.0 if together else 0.006)
    apart = 0.0 if together else 0.006
    assert np.allclose(
        elbow, np.interp(states.time - start, 0.02 * np.arange(40) + apart, qpos[:, 1]), atol=1e-6
    )
    assert np.allclose(
        shoulder, np.interp(states.time - start, 0.02 * np.arange(40), qpos[:, 0]), atol=1e-6
    )


def test_topics_keep_their_own_clocks_where_a_rate_is_stated(tmp_path, arm):
    write_bag(tmp_path / "wave")
    ((_, log),) = read_logs(tmp_path, arm, ReadOptions(rate=50.0))
    assert (len(log.channels["ctrl"].time), len(log.channels["qpos"].time)) == (20, 40)
