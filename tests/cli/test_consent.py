"""Who is asked at a terminal: what counts as consent, and what reaches the servos without it."""

from __future__ import annotations

import io
import os
import select
from collections.abc import Iterator

import pytest
from servos import Servos, on_port

from gaponet.base.errors import UsageError
from gaponet.cli.main import main
from gaponet.hw.control.consent import require_consent

NO = {
    "n": "n\n",
    "quit": "quit\n",
    "enter": "\n",
    "escape": "\x1b\n",
    "y": "y\n",
    "yes and more": "yes no\n",
    "end of file": "\x04",
    "end of file behind the word": "yes\x04",
}


class Person(io.StringIO):
    """Standard error, and a person at the terminal who answers once a question is shown there."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        self.monkeypatch = monkeypatch
        self.answer = ""
        self.master, self.slave = os.openpty()
        monkeypatch.setattr("sys.stdin", open(self.slave))  # noqa: SIM115

    def will(self, answer: str) -> None:
        """Answer so; called by a test, not by a fixture: between them pytest takes standard error
        back.
        """
        self.answer = answer
        self.monkeypatch.setattr("sys.stderr", self)

    def type(self, keys: str) -> None:
        os.write(self.master, keys.encode())

    def flush(self) -> None:
        if "leaves: " in self.getvalue() and self.answer:
            self.type(self.answer)
            self.answer = ""


@pytest.fixture
def person(monkeypatch) -> Iterator[Person]:
    person = Person(monkeypatch)
    yield person
    os.close(person.master)


@pytest.fixture
def bus() -> Iterator[tuple[str, Servos]]:
    """A port, and the servos behind it."""
    servos = Servos()
    with on_port(servos) as port:
        yield port, servos


@pytest.mark.parametrize("answer", ["yes\n", "  YES \n"])
def test_the_word_consents(person, answer):
    person.will(answer)
    require_consent("It will move.")
    assert "It will move. Is the space around it free" in person.getvalue()


@pytest.mark.parametrize("answer", NO.values(), ids=NO)
def test_nothing_but_the_word_consents(person, answer):
    person.will(answer)
    with pytest.raises(UsageError, match="'yes'"):
        require_consent("It will move.")


@pytest.mark.parametrize("early", ["\n", "yes\n", "ye"])
def test_what_was_typed_before_the_question_is_no_answer(person, early):
    person.type(early + "\n")
    assert select.select([person.slave], [], [], 10)[0]
    person.will("s\n")
    with pytest.raises(UsageError, match="'s'"):
        require_consent("It will move.")


def test_a_word_of_its_own_is_asked_for_and_yes_is_not_it(person):
    person.will("yes\n")
    with pytest.raises(UsageError, match="hangs"):
        require_consent("Legs go off.", "Does it hang?", "it hangs")
    assert "Does it hang? Type 'it hangs' to start" in person.getvalue()


def test_a_person_who_only_types_yes_has_not_said_that_the_robot_hangs(person):
    person.will("yes\n")
    words = ["run", "--driver", "unitree", "--topic", "lowcmd", "--motion", "sweep-left_elbow"]
    assert main(words) == 2
    assert "Does it hang? Type 'it hangs'" in person.getvalue()


def test_without_a_terminal_nobody_consents_and_the_option_is_named(monkeypatch):
    for stream in (io.StringIO("yes\n"), None):
        monkeypatch.setattr("sys.stdin", stream)
        with pytest.raises(UsageError, match="--free"):
            require_consent("It will move.", option="--free")


SERIAL = ["--driver", "so101", "--rate", "4", "--safety.acceleration", "2", "--damp", "0.3"]
WRITES = (0x03, 0x83)  # write, sync write


@pytest.fixture
def first(tmp_path) -> list[str]:
    """A motion of one joint."""
    pytest.importorskip("serial", reason="pip install 'gaponet[so101]'")
    (tmp_path / "first.csv").write_text("time,wrist_roll\n0.0,0.0\n0.5,0.1\n1.0,0.0\n")
    return ["--motion", str(tmp_path / "first.csv")]


@pytest.mark.parametrize("command", ["run", "record", "live"])
def test_without_yes_no_servo_is_written_to(command, person, bus, first, tmp_path):
    port, servos = bus
    words = ["run", *first]
    if command == "record":
        words = [
            "record",
            *first,
            "--payload-mass",
            "0",
            "--unit-id",
            "a",
            "--out",
            str(tmp_path / "set"),
        ]
    if command == "live":
        pytest.importorskip("zmq", reason="pip install 'gaponet[zmq]'")
        words = ["run", "--targets", "zmq", "--live.address", f"ipc://{tmp_path}/targets"]
    person.will("n\n")
    assert main([*words, *SERIAL, "--port", port]) == 2
    assert "the answer was 'n', not 'yes'; nothing was commanded" in person.getvalue()
    assert servos.heard
    assert not any(request[4] in WRITES for request in servos.heard)


def test_after_yes_servos_are_written_to_and_a_key_lets_them_go(person, bus, first, monkeypatch):
    port, servos = bus
    obey = servos.obey
    typed = []

    def obeyed(who: int, instruction: int, words: bytes) -> bytes:
        if instruction in WRITES and not typed:
            typed.append(instruction)
            person.type("\x1a")  # Ctrl-Z
        return obey(who, instruction, words)

    monkeypatch.setattr(servos, "obey", obeyed)
    person.will("yes\n")
    with pytest.raises(SystemExit, match="3"):
        main(["run", *first, *SERIAL, "--port", port])
    assert typed
    assert [servos.get(s, "torque") for s in range(1, 7)] == [0] * 6
