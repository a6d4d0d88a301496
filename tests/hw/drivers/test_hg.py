"""hg messages: layout and checksum against other implementations."""

import itertools

import numpy as np
import pytest

from gaponet.hw.drivers import hg


def slow_crc(words: np.ndarray) -> int:
    """CRC-32/MPEG-2, bit by bit."""
    crc = 0xFFFFFFFF
    for word in words.tolist():
        for bit in range(31, -1, -1):
            top = (crc >> 31) ^ ((word >> bit) & 1)
            crc = ((crc << 1) & 0xFFFFFFFF) ^ (0x04C11DB7 if top else 0)
    return crc


def test_the_checksum_is_crc32_mpeg2_of_the_padded_struct():
    import struct

    rng = np.random.default_rng(0)
    data = hg.LowCmd.new()
    values = {name: rng.standard_normal(35).astype("f4") for name in ("q", "dq", "tau", "kp", "kd")}
    for name, column in values.items():
        hg.LowCmd.set_motors(data, name, column)
    hg.LowCmd.set_motors(data, "mode", np.arange(35))
    hg.LowCmd.view(data, "mode_pr")[:] = 1
    hg.LowCmd.view(data, "mode_machine")[:] = 4
    packed = struct.pack("<2B2x", 1, 4)
    for i in range(35):
        packed += struct.pack(
            "<B3x5fI", i, *(values[n][i] for n in ("q", "dq", "tau", "kp", "kd")), 0
        )
    packed += struct.pack("<4I", 0, 0, 0, 0)
    assert hg.LowCmd.packed_size == 1004  # as the C struct
    assert hg.LowState.packed_size == 2092
    assert hg.LowCmd.checksum(data) == slow_crc(np.frombuffer(packed, "<u4"))


def bytes_under_the_checksum(message):
    """The bytes on the wire of every field but the checksum itself."""
    places = []
    for path, (kind, count, offset) in message.layout.items():
        if path != "crc":
            places += range(offset, offset + np.dtype(kind).itemsize * count)
    return places


@pytest.mark.parametrize("message", [hg.LowState, hg.LowCmd])
def test_a_changed_bit_anywhere_is_noticed(message):
    rng = np.random.default_rng(0)
    data = message.new()
    message.set_motors(data, "q", rng.standard_normal(35))
    message.seal(data)
    assert message.intact(data)
    for byte in rng.choice(bytes_under_the_checksum(message), 50):
        broken = data.copy()
        broken[byte] ^= 1 << int(rng.integers(8))
        assert not message.intact(broken)


def count_up(cls, fields, inner, counter):
    """A message of CycloneDDS whose numbers count up in the order of its fields, and after 99
    again.
    """

    def value(kind):
        if isinstance(kind, str):
            return next(counter) % 100
        return count_up(inner[id(kind)], kind, inner, counter)

    values = []
    for _, kind, count in fields:
        values.append(value(kind) if count == 1 else [value(kind) for _ in range(count)])
    return cls(*values)


@pytest.fixture
def on_the_wire():
    """A function: message of CycloneDDS by its name, and its bytes as CycloneDDS sends them."""
    pytest.importorskip("cyclonedds", reason="pip install 'gaponet[dds]'")
    from cyclonedds.idl import IdlStruct

    from gaponet.hw.drivers import dds

    inner = {
        id(hg.IMU): dds.IMUState,
        id(hg.MOTOR_STATE): dds.MotorState,
        id(hg.MOTOR_CMD): dds.MotorCmd,
    }

    def send(name):
        fields = {"LowState": hg.LOW_STATE, "LowCmd": hg.LOW_CMD}[name]
        sample = count_up(getattr(dds, name), fields, inner, itertools.count())
        return sample, IdlStruct.serialize(sample)

    return send


@pytest.mark.parametrize(("name", "part"), [("LowState", "motor_state"), ("LowCmd", "motor_cmd")])
def test_the_wire_layout_is_that_of_cyclonedds(on_the_wire, name, part):
    message = getattr(hg, name)
    sample, wire = on_the_wire(name)
    assert wire[:4] == hg.HEADER
    data = np.frombuffer(wire[4:], np.uint8)
    assert len(data) == message.wire_size
    for field in ("mode", "q", "dq"):
        expected = [getattr(motor, field) for motor in getattr(sample, part)]
        np.testing.assert_array_equal(message.motors(data, field), expected)
    assert message.view(data, "crc")[0] == sample.crc
    assert message.view(data, "mode_machine")[0] == sample.mode_machine


@pytest.mark.parametrize("name", ["LowState", "LowCmd"])
def test_a_message_that_is_written_field_by_field_is_that_of_cyclonedds(on_the_wire, name):
    message = getattr(hg, name)
    data = np.frombuffer(on_the_wire(name)[1][4:], np.uint8)
    again = message.new()
    for column in message.columns:
        message.set_motors(again, column, message.motors(data, column))
    for path in message.layout:
        if "[" not in path:
            message.view(again, path)[:] = message.view(data, path)
    np.testing.assert_array_equal(again, data)
