"""gaponet data card, split, figures, export, and import of what was exported, as a user runs
them.
"""

import json

import pytest
from arm import recordings, write_arm

from gaponet.cli.main import main
from gaponet.data.store import Dataset


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A user's robot folder and a dataset of six motions, alternately empty-handed and with 0.2
    kg.
    """
    folder = tmp_path_factory.mktemp("data")
    robot = write_arm(folder / "arm")
    dataset = Dataset.create(folder / "set", robot)
    for sequence in recordings(robot, 6, rows=60):
        dataset.append(sequence)
    return folder


def run(place, capsys, *words):
    capsys.readouterr()
    code = main([w.format(place) for w in words])
    captured = capsys.readouterr()
    assert code == 0, captured.err
    return captured


def test_the_card_says_virtual_first_asks_for_the_licence_and_keeps_it(place, capsys):
    told = run(place, capsys, "data", "card", "{}/set").out.split("\n")
    assert told[0] == "set: 6 sequences, 0.00 h of arm, all on VIRTUAL robots"
    assert "licence: not stated; set it with gaponet data card DIR --licence …" in told
    assert (
        (place / "set" / "CARD.md")
        .read_text(encoding="utf-8")
        .startswith("# set: 6 sequences, 0.00 h of arm, all on V")
    )
    out = run(
        place,
        capsys,
        "data",
        "card",
        "{}/set",
        "--licence",
        "CC-BY-4.0",
        "--source",
        "test",
        "--json",
    ).out
    card = json.loads(out)
    assert (card["licence"], card["source"], card["total"]["frames"]) == ("CC-BY-4.0", "test", 360)
    assert json.loads((place / "set" / "dataset.json").read_text())["licence"] == "CC-BY-4.0"


def test_the_card_beside_the_paper_is_printed(place, capsys):
    told = run(place, capsys, "data", "card", "{}/set", "--beside", "paper").out
    assert "Beside the paper's counts" in told
    assert "257,493" in told
    assert "do not reconcile" in " ".join(told.split())
    out = run(place, capsys, "data", "card", "{}/set", "--beside", "paper", "--json").out
    beside = json.loads(out)["beside_paper"]
    assert beside["here"]["sequences"] == 6
    assert beside["paper"]["sequences"] == 11_198


def test_a_split_is_printed_and_written(place, capsys):
    result = json.loads(
        run(
            place,
            capsys,
            "data",
            "split",
            "{}/set",
            "--by",
            "payload",
            "--holdout",
            "0.2",
            "--json",
        ).out
    )
    assert result["split"].endswith("splits/payload-0.2.json")
    assert result["parts"]["test"]["payloads_kg"] == ["0.2"]
    assert result["parts"]["train"]["sequences"] == 2
    table = run(place, capsys, "data", "split", "{}/set", "--by", "motion").out
    assert "VIRTUAL robots; parts share no recording" in " ".join(table.split())


def test_pictures_are_listed_and_what_is_left_out(place, capsys):
    words = ["data", "figures", "{}/set", "--out", "{}/pictures", "--robot", "{}/arm", "--json"]
    result = json.loads(run(place, capsys, *words).out)
    assert len(result["figures"]) == 4
    assert set(result["left_out"]) == {"torque_temperature"}
    assert (place / "pictures" / "joint_ranges.svg").is_file()


def test_export_and_import_give_the_same_recordings(place, capsys):
    run(place, capsys, "data", "export", "{}/set", "--out", "{}/lerobot")
    told = run(place, capsys, "import", "{}/lerobot", "--robot", "{}/arm", "--out", "{}/again").out
    assert "6 recordings" in told
    assert "VIRTUAL robot arm, unit a, payload 0, 0.2 kg" in told
    one = Dataset(place / "set")
    other = Dataset(place / "again")
    assert [e.hash for e in one.entries] == [e.hash for e in other.entries]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["data", "card", "{}/nowhere"], "Dataset: {}/nowhere: not a dataset"),
        (["data", "split", "{}/set", "--by", "unit"], "Usage: {}/set: one unit only (a)"),
        (
            ["data", "split", "{}/set", "--by", "payload", "--holdout", "5"],
            "no payload '5' to hold out; it holds 0,",
        ),
        (["data", "figures", "{}/set", "--out", "{}/p", "--robot", "so101"], "holds robot 'arm'"),
        (
            ["data", "export", "{}/set", "--out", "{}/set"],
            "set: exists and is not an empty folder; choose a new one",
        ),
        (
            [
                "import",
                "{}/set/sequences",
                "--robot",
                "{}/arm",
                "--out",
                "{}/new",
                "--format",
                "lerobot",
            ],
            "no meta/info.json in it; point at a LeRobotDataset v3.0 folder",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value[:2]),
)
def test_mistakes_get_one_line_and_exit_code_2(place, capsys, words, complaint):
    capsys.readouterr()
    assert main([w.format(place) for w in words]) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert complaint.format(place) in last
    assert not (place / "new").exists()


def test_an_action_that_is_none_lists_those_that_are(capsys):
    with pytest.raises(SystemExit):
        main(["data", "polish"])
    assert "card" in capsys.readouterr().err
