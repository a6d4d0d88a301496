"""ROS 2 bag (.db3, .mcap, or their folder), or ROS 1 .bag: command and state topics, joined in
time.

Signals are called TOPIC.field[joint]: every array of numbers of any message whose definition is in
the bag, or known (JointState's TOPIC.position, Float64MultiArray's TOPIC.data, TOPIC.motors.q of a
message that holds a list of motors); joints have the names of a list of texts that is as long, or
numbers. Read in their own way are JointTrajectory with one point a message,
JointTrajectoryControllerState (TOPIC.reference.position, …) and Unitree's LowState and LowCmd (.q,
.dq, .tau_est, .kp; motors by number). Where a bag has one topic with states and one with commands,
these are taken; else logs.toml says which: ctrl = "/arm/commands.data". A topic has the clock of
its header's stamps, and the recorder's where it has none. Stamps that run away from the recorder's
clock, or from those of the other topic, are moved onto it by a straight line; that, and repeated
messages that were dropped, stand in the notes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError
from gaponet.base.sandbox import sandboxed
from gaponet.data.describe.actions import words_of
from gaponet.data.describe.logs_file import LogsFile
from gaponet.data.describe.raw_recording import RawRecording, Signal, reading
from gaponet.data.formats import files_under

SUFFIXES = (".db3", ".mcap", ".bag")
EXTRA = "ros"
DEFAULT: LogsFile = {"time_unit": "s", "position_unit": "rad"}
MAX_PEEKED = 200  # messages of a topic in which all its joints are named
# By which a stamp may lie before the recorder's clock, and by which topics may differ in that.
MAX_LATENCY_S = 0.1
MAX_DRIFT_S = 0.005  # by which a stamp may run away from the recorder's clock during a recording
COMMAND_WORDS = ("command", "cmd", "desired", "target", "goal", "reference", "setpoint")
# words of topics whose numbers without names are no positions
NO_POSITIONS = {"velocity", "vel", "effort", "torque", "current", "acceleration", "cartesian"}
COMMAND_FIELDS = (".position", ".point", ".data", ".q")  # that hold commanded positions
# Ends of signals, those that say most of a command first.
BEST_COMMANDS = (
    (".reference.position", ".desired.position"),
    (".q",),
    (".position",),
    (".point",),
    (".data",),
)
# Unitree's hg messages, for bags that do not hold the definitions of their messages; fields as in
# its public IDL.
HG = {
    "MotorCmd": "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 tau\nfloat32 kp\nfloat32 kd\nuint32 "
    "reserve",
    "LowCmd": "uint8 mode_pr\nuint8 mode_machine\nMotorCmd[35] motor_cmd\nuint32[4] "
    "reserve\nuint32 crc",
    "MotorState": "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 ddq\nfloat32 tau_est\nint16[2] "
    "temperature\nfloat32 vol\nuint32[2] sensor\nuint32 motorstate\nuint32[4] reserve",
    "IMUState": "float32[4] quaternion\nfloat32[3] gyroscope\nfloat32[3] "
    "accelerometer\nfloat32[3] rpy\nint16 temperature",
    "LowState": "uint32[2] version\nuint8 mode_pr\nuint8 mode_machine\nuint32 tick\nIMUState "
    "imu_state\nMotorState[35] motor_state\nuint8[40] wireless_remote\nuint32[4] reserve\nuint32 "
    "crc",
}
POINT = "trajectory_msgs/JointTrajectoryPoint"
# packages and messages of what is seen, of bodies and of the system itself
NOT_JOINTS = re.compile(
    r"(sensor_msgs/msg/(?!JointState$)|nav_msgs|tf2?_msgs|geometry_msgs|visualization_msgs"
    r"|rosgraph_msgs|rcl_interfaces|diagnostic_msgs|stereo_msgs|vision_msgs|action_msgs"
    r"|lifecycle_msgs|statistics_msgs|std_msgs/msg/U?Int8).*"
)
MAX_NUMBERS = 256  # of a field: more is a picture
CONTROLLER = (
    f"std_msgs/Header header\nstring[] joint_names\n{POINT} reference\n{POINT} feedback\n"
    f"{POINT} error\n{POINT} output"
)
INTERFACES = {
    "InterfaceValue": "string[] interface_names\nfloat64[] values",
    "DynamicJointState": "std_msgs/Header header\nstring[] "
    "joint_names\ncontrol_msgs/InterfaceValue[] interface_values",
}
# Time in which a point of a trajectory may be reached and still count as a command at once.
MAX_TIME_FROM_START_S = 0.2
Fields = dict[str, tuple[tuple[str, ...], Any]]  # field → (names of its columns, its numbers)
Wanted = dict[str, dict[str, tuple[str, ...]]]  # topic → field → names of its columns


def find(path: Path) -> list[Path]:
    """Bags: folders with metadata.yaml, and files that lie in none."""
    bags = set()
    for file in files_under(path, SUFFIXES):
        is_part = path.is_dir() and (file.parent / "metadata.yaml").is_file()
        bags.add(file.parent if is_part else file)
    return sorted(bags)


def recordings(path: Path, specified: LogsFile) -> Iterator[RawRecording]:
    """Every bag."""
    for bag in find(path):
        signals = {}
        for topic, fields in _peeked(bag).items():
            for field, labels in fields.items():
                signals[f"{topic}.{field}"] = labels
        meta: dict[str, Any] = {}
        yield RawRecording(
            bag.name if bag.is_dir() else bag.stem,
            str(bag),
            signals,
            partial(_load, bag, meta),
            files=tuple(map(str, files_under(bag, SUFFIXES))),
            meta=meta,
            default=_usual(signals),
        )


def _usual(signals: dict[str, tuple[str, ...]]) -> LogsFile:
    """Which signals are command and state, where only one of each can be."""
    positions = [signal for signal in signals if signal.endswith((".position", ".q"))]
    states = [signal for signal in positions if not _is_command(signal)]
    if len(states) > 1:  # a controller's feedback repeats what another topic says
        states = [signal for signal in states if not _is_feedback(signal)] or states
    targets = [signal for signal in signals if signal.endswith(COMMAND_FIELDS)]
    commands = [signal for signal in targets if _is_command(signal) and _may_be_positions(signal)]
    specified: LogsFile = {}
    if len(states) == 1:
        specified |= _of_state(states[0], signals)
    command = _best_command(signals, commands, states)
    if command:
        specified |= _of_command(command, signals)
    return specified


def _may_be_positions(signal: str) -> bool:
    """Return False for numbers without names in a topic of speeds or torques."""
    return not (signal.endswith(".data") and NO_POSITIONS & words_of(signal))


def _is_feedback(signal: str) -> bool:
    """Return True for the measured part of a controller's state."""
    return ".feedback." in signal or ".actual." in signal


def _is_command(signal: str) -> bool:
    if _is_feedback(signal):
        return False
    return signal.endswith(".point") or any(word in signal.lower() for word in COMMAND_WORDS)


def _of_state(position: str, signals: Container[str]) -> LogsFile:
    """Return a state's position, and the velocity and torque beside it."""
    topic, _, field = position.rpartition(".")
    velocity = f"{topic}.velocity"
    torque = f"{topic}.effort"
    if field == "q":
        velocity = f"{topic}.dq"
        torque = f"{topic}.tau_est"
    specified: LogsFile = {"qpos": position}
    if velocity in signals:
        specified["qvel"] = velocity
    if torque in signals:
        specified["tau"] = torque
    return specified


def _of_command(position: str, signals: Container[str]) -> LogsFile:
    """Return a command's position, and the gains and the feed-forward torque beside it."""
    topic = position.rpartition(".")[0]
    specified: LogsFile = {"ctrl": position}
    if f"{topic}.kp" in signals:
        specified["kp"] = f"{topic}.kp"
        specified["kd"] = f"{topic}.kd"
        if f"{topic}.tau" in signals:
            specified["feedforward_torque"] = f"{topic}.tau"
    return specified


def _best_command(
    signals: dict[str, tuple[str, ...]], commands: list[str], states: list[str]
) -> str | None:
    """Return the command signal, where one can be told: it names the state's joints, and a
    controller's reference says more than the goals that it was sent.
    """
    if len(states) == 1:
        joints = set(signals[states[0]])
        fitting = []
        for command in commands:
            columns = signals[command]
            if joints & set(columns) or len(columns) == len(joints):
                fitting.append(command)
        commands = fitting or commands
    for endings in BEST_COMMANDS:
        alike = [command for command in commands if command.endswith(endings)]
        if len(alike) == 1:
            return alike[0]
        if alike:
            return None
    return None


@contextmanager
def _opened(bag: Path) -> Iterator[Any]:
    """A reader of the bag."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in HG.items():
        store.register(get_types_from_msg(text, f"unitree_hg/msg/{name}"))
    store.register(
        get_types_from_msg(CONTROLLER, "control_msgs/msg/JointTrajectoryControllerState")
    )
    for name, text in INTERFACES.items():
        store.register(get_types_from_msg(text, f"control_msgs/msg/{name}"))
    with reading(bag, "bag"), AnyReader([bag], default_typestore=store) as reader:
        yield reader


class _Message(NamedTuple):
    """One message of a bag."""

    connection: Any
    received: float  # by the recorder's clock, s
    fields: Fields
    stamp: float | None  # of its header, s; None where it has none


def _messages(reader: Any, connections: list[Any]) -> Iterator[_Message]:
    """Yield the messages of some connections."""
    for connection, received_ns, raw in reader.messages(connections):
        message = reader.deserialize(raw, connection.msgtype)
        header = getattr(getattr(message, "header", None), "stamp", None)
        stamp = None
        if header is not None and (header.sec or header.nanosec):
            stamp = header.sec + 1e-9 * header.nanosec
        fields_of = KINDS.get(connection.msgtype, _numbers)
        fields = fields_of(connection.topic, message)
        yield _Message(connection, 1e-9 * received_ns, fields, stamp)


def _known(reader: Any) -> list[Any]:
    """Return the connections whose messages are defined, and may be about joints."""
    defined = reader.typestore.types
    connections = []
    for connection in reader.connections:
        kind = connection.msgtype
        if connection.msgcount and kind in defined and not NOT_JOINTS.match(kind):
            connections.append(connection)
    return connections


@sandboxed(LogError, "rosbags.highlevel", 4.0)
def _peeked(bag: Path) -> Wanted:
    with _opened(bag) as reader:
        return _peek(bag, reader)


def _peek(bag: Path, reader: Any) -> Wanted:
    """Return topic → field → names of its columns, in all messages together: several publishers may
    tell of some joints each.

    An array without names that has another length than the one before is a field of TOPIC#2.
    """
    topics: Wanted = {}
    for connection in _known(reader):
        # field → names of its columns in TOPIC, TOPIC#2, …
        sets: dict[str, list[tuple[str, ...]]] = {}
        for message in islice(_messages(reader, [connection]), MAX_PEEKED + 1):
            for field, (labels, _) in message.fields.items():
                of_field = sets.setdefault(field, [])
                number = _join(of_field, labels)
                topic = f"{connection.topic}#{number + 1}" if number else connection.topic
                topics.setdefault(topic, {})[field] = of_field[number]
    if not topics:
        raise _no_joints(bag, reader)
    return topics


def _no_joints(bag: Path, reader: Any) -> LogError:
    """Return the error that no topic of a bag is about joints."""
    kinds = {connection.msgtype for connection in reader.connections}
    undefined = sorted(kinds - set(reader.typestore.types))
    why = ""
    if undefined:
        why = f"; the bag does not define {', '.join(undefined)}: record as .mcap, which does"
    types = ", ".join(sorted(kinds)) or "no topics at all"
    return LogError(f"{bag}: none of its topics is about joints; it has {types}{why}")


def _join(sets: list[tuple[str, ...]], labels: tuple[str, ...]) -> int:
    """Add names of columns to the first set that they belong to, or as a new set; return its
    number.
    """
    for number, known in enumerate(sets):
        if _joined(known, labels):
            sets[number] = tuple(dict.fromkeys((*known, *labels)))
            return number
    sets.append(labels)
    return len(sets) - 1


def _joined(known: tuple[str, ...], labels: tuple[str, ...]) -> bool:
    """Return True if both name columns of one array: the same numbers, or names of joints."""
    if _are_numbers(known) or _are_numbers(labels):
        return known == labels
    return True


def _are_numbers(labels: tuple[str, ...]) -> bool:
    return all(label.isdigit() for label in labels)


def _load(bag: Path, meta: dict[str, Any], names: list[str]) -> dict[str, Signal]:
    """The signals of these names, each on the clock of its topic."""
    loaded, meta["notes"] = _read(bag, names)
    return loaded


class _Row(NamedTuple):
    """What one message tells of the wanted fields of a topic."""

    received: float  # by the recorder's clock, s
    stamp: float  # by its header, s; the recorder's where it has none
    stamped: bool
    # by field, in the order of its columns; NaN for those of which it tells nothing
    values: list[list[float]]


@dataclass(frozen=True)
class _Stamps:
    """Times of the messages of one topic, (k) s."""

    received: Array
    stamp: Array
    all_stamped: bool

    @classmethod
    def of(cls, rows: list[_Row]) -> _Stamps:
        return cls(
            received=np.array([row.received for row in rows], float),
            stamp=np.array([row.stamp for row in rows], float),
            all_stamped=all(row.stamped for row in rows),
        )


@sandboxed(LogError, "rosbags.highlevel", 4.0)
def _read(bag: Path, names: list[str]) -> tuple[dict[str, Signal], dict[str, Any]]:
    """Return the signals of these names, and notes."""
    with _opened(bag) as reader:
        wanted = _wanted(_peek(bag, reader), names)
        rows, in_parts = _collect(reader, wanted)
    notes: dict[str, Any] = {}
    stamps = {topic: _Stamps.of(of_topic) for topic, of_topic in rows.items()}
    times = _clocks(stamps, notes)
    loaded: dict[str, Signal] = {}
    repeated = 0
    for topic, columns_of in wanted.items():
        time = times[topic]
        columns = []  # of each field, (k, columns)
        for i in range(len(columns_of)):
            columns.append(np.array([row.values[i] for row in rows[topic]], float))
        if topic in in_parts:
            time, columns = _together(time, columns)
        fresh = _fresh(time, columns)
        if not fresh.all():
            repeated += int((~fresh).sum())
        for field, values in zip(columns_of, columns, strict=True):
            loaded[f"{topic}.{field}"] = Signal(values[fresh], time[fresh])
    if repeated:
        notes["repeated"] = {"rows": repeated}
    return {name: loaded[name] for name in names}, notes


def _wanted(topics: Wanted, names: list[str]) -> Wanted:
    """Return the fields of these names, and the topics that have any."""
    wanted: Wanted = {}
    for topic, fields in topics.items():
        mine = {field: labels for field, labels in fields.items() if f"{topic}.{field}" in names}
        if mine:
            wanted[topic] = mine
    return wanted


def _collect(reader: Any, wanted: Wanted) -> tuple[dict[str, list[_Row]], set[str]]:
    """Return the rows of each wanted topic, one for each message that tells of it, and the topics
    of which some message tells of a part of the joints only.

    Messages of /joints may belong to /joints, or to /joints#2 (_peek).
    """
    rows: dict[str, list[_Row]] = {topic: [] for topic in wanted}
    in_parts = set[str]()
    used = {_without_number(topic) for topic in wanted}
    connections = [connection for connection in _known(reader) if connection.topic in used]
    for message in _messages(reader, connections):
        for topic, columns_of in wanted.items():
            if _without_number(topic) != message.connection.topic:
                continue
            told = _told(message.fields, columns_of)
            if not told:
                continue
            if not _tells_all(told, columns_of):
                in_parts.add(topic)
            values = [_in_order(told.get(field), labels) for field, labels in columns_of.items()]
            rows[topic].append(_row(message, values))
    return rows, in_parts


def _row(message: _Message, values: list[list[float]]) -> _Row:
    if message.stamp is None:
        return _Row(message.received, stamp=message.received, stamped=False, values=values)
    return _Row(message.received, stamp=message.stamp, stamped=True, values=values)


def _without_number(topic: str) -> str:
    """Return the name of a topic as the bag has it: /joints#2 → /joints."""
    return topic.split("#")[0]


def _told(fields: Fields, columns_of: dict[str, tuple[str, ...]]) -> Fields:
    """Return the fields of a message that are wanted, all of whose columns are known.

    Args:
        columns_of: Wanted field → names of its columns, in all messages together.
    """
    told: Fields = {}
    for field, labels in columns_of.items():
        if field in fields and set(fields[field][0]) <= set(labels):
            told[field] = fields[field]
    return told


def _tells_all(told: Fields, columns_of: dict[str, tuple[str, ...]]) -> bool:
    """Return True if a message tells of every column of every wanted field."""
    if len(told) < len(columns_of):
        return False
    return all(set(columns_of[field]) <= set(own) for field, (own, _) in told.items())


def _in_order(told: tuple[tuple[str, ...], Any] | None, labels: tuple[str, ...]) -> list[float]:
    """Return the numbers of a message in the order of labels; NaN for joints of which it tells
    nothing.
    """
    if told is None:
        return [np.nan] * len(labels)
    own, numbers = told
    if own == labels:
        return list(numbers)
    by_name = dict(zip(own, numbers, strict=True))
    return [by_name.get(name, np.nan) for name in labels]


def _together(time: Array, columns: list[Array]) -> tuple[Array, list[Array]]:
    """Return rows in the order of time, with one row for all messages of an instant, which tell of
    some joints each.

    Args:
        time: Of the messages, (k) s.
        columns: Values of each field, (k, n); NaN for joints of which a message tells nothing.
    """
    order = np.argsort(time, kind="stable")
    time = time[order]
    is_first = np.r_[True, np.diff(time) > 0]  # of its instant
    row_of = np.cumsum(is_first) - 1  # message → row
    joined = []
    for values in columns:
        values = values[order]
        rows = np.full((row_of[-1] + 1, values.shape[1]), np.nan)
        messages, joints = np.nonzero(np.isfinite(values))
        rows[row_of[messages], joints] = values[messages, joints]
        joined.append(rows)
    return time[is_first], joined


def _fresh(time: Array, columns: list[Array]) -> Array:
    """Return which rows, (k) bool, are no second copy of the row before, at the same time.

    Args:
        columns: Values of each field, (k, n).
    """
    same = np.diff(time) == 0
    for values in columns:
        same &= (np.diff(values, axis=0) == 0).all(axis=1)
    fresh = np.ones(len(time), bool)
    fresh[1:] = ~same
    return fresh


def _clocks(stamps: dict[str, _Stamps], notes: dict[str, Any]) -> dict[str, Array]:
    """Return the time of the rows of each topic, s, all on one clock; what was done is noted."""
    # of received − stamp over time since the first: slope, s/s, and start, s
    lines: dict[str, Array] = {}
    for topic, times in stamps.items():
        if len(times.stamp) > 1 and times.all_stamped:
            since_first = times.received - times.received[0]
            lines[topic] = np.polyfit(since_first, times.received - times.stamp, 1)
    moved = _must_be_moved(stamps, lines)
    clocks = {}
    for topic, times in stamps.items():
        clocks[topic] = times.stamp
        if topic not in lines:
            clocks[topic] = times.received
            notes.setdefault("clock", {})[topic] = "the recorder's: no stamps"
        elif moved:
            rate, start = lines[topic]
            clocks[topic] = times.stamp + start + rate * (times.received - times.received[0])
            notes.setdefault("clock", {})[topic] = (
                f"stamps moved by {start:.4f} s and {1e6 * rate:.0f} ppm"
            )
    return clocks


def _must_be_moved(stamps: dict[str, _Stamps], lines: dict[str, Array]) -> bool:
    """Return True if stamps are of several clocks: topics lie apart, or one runs away.

    Args:
        lines: As in _clocks.
    """
    late = [float(start) for _, start in lines.values()]
    if len(lines) < len(stamps):
        late.append(0.0)  # a topic with the recorder's clock
    if len(stamps) > 1 and max(late) - min(late) > MAX_LATENCY_S:
        return True
    drifts = []
    for topic, (rate, _) in lines.items():
        drifts.append(abs(float(rate)) * float(np.ptp(stamps[topic].received)))
    return max(drifts, default=0.0) > MAX_DRIFT_S


def _numbers(topic: str, message: Any) -> Fields:
    """Numbers of any message: its arrays of numbers, and a number of each part where it holds a
    list of parts.
    """
    messages: Fields = {}
    texts: list[tuple[str, ...]] = []
    for name in message.__dataclass_fields__:
        value = getattr(message, name)
        if _is_numeric(value):
            messages[name] = ((), value)
        elif isinstance(value, list) and value:
            if isinstance(value[0], str):
                texts.append(tuple(value))
            elif hasattr(value[0], "__dataclass_fields__"):
                messages |= _numbers_of_parts(name, value)
                texts += _names_of_parts(value)
        elif hasattr(value, "__dataclass_fields__") and name != "header":
            for field, numbers in _numbers(topic, value).items():
                messages[f"{name}.{field}"] = numbers
    return _labelled(messages, texts)


def _is_numeric(value: Any) -> bool:
    """Return True for an array of numbers; bytes are no numbers, but a picture."""
    if not isinstance(value, np.ndarray):
        return False
    return value.dtype.kind in "fiu" and value.dtype.itemsize > 1


def _numbers_of_parts(name: str, parts: list[Any]) -> Fields:
    """Return each field that holds a number in the parts of a list, as the array NAME.field."""
    messages: Fields = {}
    for field in parts[0].__dataclass_fields__:
        if isinstance(getattr(parts[0], field), int | float):
            messages[f"{name}.{field}"] = ((), [getattr(part, field) for part in parts])
    return messages


def _names_of_parts(parts: list[Any]) -> list[tuple[str, ...]]:
    """Return the names of the parts of a list, if all have one."""
    texts = []
    for field in ("name", "joint_name"):
        names = tuple(getattr(part, field, "") for part in parts)
        if all(names):
            texts.append(names)
    return texts


def _labelled(messages: Fields, texts: list[tuple[str, ...]]) -> Fields:
    """Return the fields of at most MAX_NUMBERS numbers; those without names get the first texts of
    their length, or digits.
    """
    labelled: Fields = {}
    for field, (labels, numbers) in messages.items():
        count = len(numbers)
        if not 0 < count <= MAX_NUMBERS:
            continue
        digits = tuple(str(i) for i in range(count))
        named = next((names for names in texts if len(names) == count), digits)
        labelled[field] = (labels or named, numbers)
    return labelled


def _controller(topic: str, message: Any) -> Fields:
    """Return the points of a controller's state, as far as they hold a number for each joint."""
    names = tuple(message.joint_names)
    fields: Fields = {}
    for part in ("reference", "desired", "feedback", "actual"):
        point = getattr(message, part, None)
        if point is None:
            continue
        fields[f"{part}.position"] = (names, point.positions)
        fields[f"{part}.velocity"] = (names, point.velocities)
        fields[f"{part}.effort"] = (names, point.effort)
    return {name: field for name, field in fields.items() if len(field[1]) == len(names)}


def _dynamic(topic: str, message: Any) -> Fields:
    """Interfaces of DynamicJointState, such as position and effort, each with the joints that have
    it.
    """
    found: dict[str, dict[str, float]] = {}
    for joint, part in zip(message.joint_names, message.interface_values, strict=True):
        for interface, value in zip(part.interface_names, part.values, strict=True):
            found.setdefault(interface.rpartition("/")[2], {})[joint] = value
    return {name: (tuple(joints), list(joints.values())) for name, joints in found.items()}


def _trajectory(topic: str, message: Any) -> Fields:
    """Return the only point of a trajectory; refuse one of several, and one that is to be reached
    slowly: nobody recorded what the controller asked for on the way.
    """
    points = message.points
    if not points:
        return {}
    takes = points[0].time_from_start
    seconds = takes.sec + 1e-9 * takes.nanosec
    problem = ""
    if len(points) > 1:
        problem = f"sends whole trajectories ({len(points)} points)"
    elif seconds > MAX_TIME_FROM_START_S:
        problem = f"sends points that are to be reached in {seconds:g} s"
    if problem:
        raise LogError(
            f"{topic} {problem}; what the controller made of them stands in its state topic "
            '(…/controller_state): record that, and say ctrl = "…" in logs.toml'
        )
    return {"point": (tuple(message.joint_names), points[0].positions)}


def _motors(field: str, names: tuple[str, ...]) -> Callable[[str, Any], Fields]:
    """Return what reads a list of motors (field), and some numbers (names) of each."""

    def fields(topic: str, message: Any) -> Fields:
        motors = getattr(message, field)
        labels = tuple(map(str, range(len(motors))))
        return {name: (labels, [getattr(motor, name) for motor in motors]) for name in names}

    return fields


LOW_STATE = _motors("motor_state", ("q", "dq", "tau_est"))
LOW_CMD = _motors("motor_cmd", ("q", "dq", "tau", "kp", "kd"))
KINDS: dict[str, Callable[[str, Any], Fields]] = {
    "trajectory_msgs/msg/JointTrajectory": _trajectory,
    "control_msgs/msg/JointTrajectoryControllerState": _controller,
    "control_msgs/msg/DynamicJointState": _dynamic,
    "unitree_hg/msg/LowState": LOW_STATE,
    "unitree_go/msg/LowState": LOW_STATE,
    "unitree_hg/msg/LowCmd": LOW_CMD,
    "unitree_go/msg/LowCmd": LOW_CMD,
}
