"""File contents become the stated type or a one-line error with file and field."""

from dataclasses import dataclass
from typing import Annotated

import pytest
from annotated_types import Interval

from gaponet.base.errors import RobotError
from gaponet.base.structure import parse_json, read_json, read_toml, validated


@dataclass(frozen=True)
class Servo:
    gain: Annotated[float, Interval(ge=0, le=100)]
    names: tuple[str, ...] = ()

    def __post_init__(self):
        if self.names == ("tail",):
            raise RobotError("arms have no tail")


GOOD = {"gain": 2, "names": ["pan"]}
BAD = [
    ({"gain": "2"}, "gain: should be a valid number, not '2'"),
    ({"gain": True}, "gain: should be a valid number, not True"),
    ({"gain": float("nan")}, "gain: should be a finite number, not nan"),
    ({"gain": 10**400}, "gain: should be a finite number"),
    ({"gain": 101}, "gain: should be less than or equal to 100, not 101"),
    ({"gain": 1, "names": ["pan", 3]}, "names[1]: should be a valid string, not 3"),
    ({"gain": 1, "names": ["\ud800"]}, "surrogates"),
    ({"gain": 1, "gian": 1}, "gian: is not a known field"),
    ({}, "gain: is missing"),
    (None, "holds nothing"),
    ([GOOD], "should be an object"),
    ({"gain": 1, "names": ["tail"]}, "arms have no tail"),
]


def test_a_valid_table_becomes_its_type_with_tuples_and_floats():
    assert validated(Servo, GOOD, "f", RobotError) == Servo(2.0, ("pan",))


@pytest.mark.parametrize(("data", "said"), BAD)
def test_an_invalid_table_gives_one_line_with_file_field_and_hint(data, said):
    with pytest.raises(RobotError) as error:
        validated(Servo, data, "robot.toml", RobotError, "mend it")
    text = str(error.value)
    assert text.startswith("robot.toml: ")
    assert said in text
    assert text.endswith("; mend it")
    assert "\n" not in text
    assert len(text) < 250


@pytest.mark.parametrize(
    "text", [b"", b"{", b"\xff", b"[" * 100_000, b'{"gain": ' + b"9" * 5000 + b"}", b'"\\ud800"']
)
def test_invalid_json_gives_one_line(text):
    with pytest.raises(RobotError, match="JSON"):
        parse_json(Servo, text, "card.json", RobotError)


def test_missing_files_folders_and_huge_files_are_refused_before_reading(tmp_path):
    huge = tmp_path / "huge"
    with huge.open("wb") as file:
        file.truncate(1 << 40)
    for path in (tmp_path / "absent", tmp_path, huge):
        for read in (read_json, read_toml):
            with pytest.raises(RobotError, match=path.name):
                read(Servo, path, RobotError)


@pytest.mark.parametrize(
    "text", [b"gain = ", b"gain = nan", b"\xff", b"gain = " + b"[" * 5000, b"gain=" + b"9" * 5000]
)
def test_invalid_toml_gives_one_line(tmp_path, text):
    file = tmp_path / "robot.toml"
    file.write_bytes(text)
    with pytest.raises(RobotError, match="robot"):
        read_toml(Servo, file, RobotError)
