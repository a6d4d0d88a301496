"""gaponet view as a user types it."""

import json

import pytest
from arm import recordings, write_arm

from gaponet.cli.main import main
from gaponet.data.store import Dataset


@pytest.fixture
def place(tmp_path):
    robot = write_arm(tmp_path / "arm")
    dataset = Dataset.create(tmp_path / "data", robot)
    for sequence in recordings(robot, 2, rows=80, kp=0.5):
        dataset.append(sequence)
    return tmp_path


def view(place, *words):
    return main(["view", str(place / "data"), "--robot", str(place / "arm"), *words])


def test_a_picture_is_written_and_the_numbers_printed(place, capsys):
    code = view(
        place, "--render", str(place / "a.png"), "--width", "240", "--duration", "0.5", "--json"
    )
    captured = capsys.readouterr()
    if code == 2 and "render off screen" in captured.err:
        pytest.skip(captured.err.strip())
    found = json.loads(captured.out)
    assert code == 0
    assert found["virtual"] is True
    assert "VIRTUAL" in captured.err
    assert set(found["mpjae"]) == {"target", "nominal"}
    assert (place / "a.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--render", "a.avi"], ".gif, .mp4, .png"),
        (["--render", "a.png", "--show", "gaponet"], "models are given with --model RUN"),
        (["--render", "a.png", "--motion", "dance"], "no motion 'dance'"),
        (["--render", "a.png", "--unit", "b"], "there are a with 0 kg, a with 0.2 kg"),
        (["--render", "a.png", "--width", "10"], "160 to 3840"),
        (["--render", "a.png", "--model", "{}/data"], "give a run folder"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_mistakes_get_one_line_and_exit_code_2(place, capsys, monkeypatch, words, complaint):
    monkeypatch.chdir(place)
    assert view(place, *(w.format(place) for w in words)) == 2
    assert complaint in capsys.readouterr().err.strip().splitlines()[-1]
