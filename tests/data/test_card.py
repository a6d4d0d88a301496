"""The data card: numbers worked by hand, and words that say what was not measured."""

import json

import numpy as np
import pytest
from logs import arm_sequence, late, wave

from gaponet.base.errors import DatasetError
from gaponet.data.card import card_markdown, headline, make_card, write_card
from gaponet.data.store import Dataset


def ramp(rows: int, top: float) -> np.ndarray:
    """Two joints: 0 to top, and half of it."""
    return np.linspace(0, 1, rows)[:, None] * np.array([top, top / 2])


@pytest.fixture
def dataset(arm, tmp_path):
    """Unit a empty (50 rows) and with 0.2 kg (100 rows), unit b empty (100 rows); 0.02 s a row."""
    data = Dataset.create(tmp_path / "data", arm)
    data.append(arm_sequence(arm, ramp(50, 0.4), ramp(50, 0.4), "up"))
    data.append(
        arm_sequence(arm, ramp(100, 0.8), ramp(100, 0.6), "up", 0.2, tau=np.full((100, 2), -3.0))
    )
    data.append(arm_sequence(arm, -ramp(100, 0.8), -ramp(100, 0.8), "down", unit="b"))
    return data


def test_counts_come_from_the_files(dataset):
    card = make_card(dataset)
    assert card["total"] == {
        "sequences": 3,
        "hours": pytest.approx(250 * 0.02 / 3600),
        "frames": 250,
        "motions": 2,
    }
    shares = card["shares"]
    assert {k: v["frames"] for k, v in shares["payload_kg"].items()} == {"0": 150, "0.2": 100}
    assert {k: v["sequences"] for k, v in shares["unit"].items()} == {"a": 2, "b": 1}
    assert {k: v["motions"] for k, v in shares["rate_hz"].items()} == {"50": 2}
    assert list(shares["level"]) == ["whole_body"]


def test_ranges_are_those_of_the_samples(dataset):
    card = make_card(dataset)
    shoulder = card["signals"]["qpos"]["joints"]["shoulder"]
    assert (shoulder["min"], shoulder["max"]) == (pytest.approx(-0.8), pytest.approx(0.6))
    every = np.concatenate([dataset.read(e).qpos[:, 0] for e in dataset.entries])
    assert shoulder["mean"] == pytest.approx(every.mean(), abs=1e-6)
    assert shoulder["std"] == pytest.approx(every.std(), rel=1e-5)
    assert (shoulder["p1"], shoulder["p99"]) == pytest.approx(
        np.percentile(every, [1, 99]), rel=1e-5
    )
    tau = card["signals"]["tau"]
    assert (tau["sequences"], tau["unit"], tau["joints"]["elbow"]["mean"]) == (1, "N·m", -3.0)
    assert "temperature" not in card["signals"]


def test_repeatability_is_the_spread_over_repetitions(arm, tmp_path):
    """Repetitions have one command, are compared as far as the shortest goes, and in joints that were commanded."""
    data = Dataset.create(tmp_path / "data", arm)
    with pytest.raises(DatasetError, match="holds no sequences yet"):
        make_card(data)
    ctrl = wave(80, 2) * [1, 0] + [0, 0.3]
    for rows, shift in ((80, -0.01), (60, 0.0), (70, 0.01)):  # standard deviation 0.01 in every row
        data.append(arm_sequence(arm, ctrl[:rows], late(ctrl, 2)[:rows] + shift))
    data.append(arm_sequence(arm, 2 * ctrl, ctrl))
    found = make_card(data)["repeatability"]
    assert (found["groups"], found["sequences"], found["left_out_other_command"]) == (1, 3, 1)
    assert found["channels"]["qpos"]["joints"] == {"shoulder": pytest.approx(0.01, rel=1e-3)}
    assert found["channels"]["qvel"]["mean"] == pytest.approx(
        0, abs=2e-3
    )  # the ends of derivatives differ


def test_virtual_is_said_in_the_first_line(dataset):
    card = make_card(dataset)
    assert headline(card) == "data: 3 sequences, 0.00 h of arm"
    assert headline(card | {"virtual_sequences": 3}).endswith(", all on VIRTUAL robots")
    assert headline(card | {"virtual_sequences": 1}).endswith(", 1 of them on VIRTUAL robots")


def test_a_licence_that_was_not_stated_says_how_to(dataset):
    text = card_markdown(make_card(dataset))
    assert "- licence: not stated; set with `gaponet data card DIR --licence …`" in text
    dataset.set_provenance(licence="CC-BY-4.0", source="a laboratory")
    card = make_card(Dataset(dataset.path))
    assert (card["licence"], card["source"]) == ("CC-BY-4.0", "a laboratory")
    dataset.set_provenance(licence="")
    assert make_card(Dataset(dataset.path))["licence"] == "not stated"


def test_the_card_is_written_beside_the_data(dataset):
    card = make_card(dataset)
    write_card(dataset, card)
    assert json.loads((dataset.path / "card.json").read_text(encoding="utf-8")) == card
    text = (dataset.path / "CARD.md").read_text(encoding="utf-8")
    assert "| 0.2 | 1 | 0.00 | 100 | 1 |" in text
    assert "No motion was repeated with the same command" in text
    assert len(Dataset(dataset.path)) == 3
