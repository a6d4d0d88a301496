"""The data card: numbers worked by hand, and words that say what was not measured."""

import json

import numpy as np
import pytest
from logs import arm_sequence, late, repeated_motions, wave

from gaponet.base.errors import DatasetError
from gaponet.data.card import beside_paper, card_markdown, headline, make_card, write_card
from gaponet.data.paper_counts import PAPER, count_as_paper
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
    """Repetitions have one command, are compared as far as the shortest goes, and in joints that
    were commanded.
    """
    data = Dataset.create(tmp_path / "data", arm)
    with pytest.raises(DatasetError, match="sequences"):
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


def test_the_paper_s_counts_are_those_that_it_prints():
    assert (PAPER.hours, PAPER.sequences, PAPER.frames) == (28.46, 11_198, 257_493)
    assert (PAPER.units, PAPER.joints, PAPER.repetitions, PAPER.signals) == (4, 10, 3, 6)
    assert (PAPER.payloads_kg, PAPER.rates_hz) == ((0, 1, 2, 3), (50, 100))


def test_a_dataset_is_counted_as_the_paper_counts(dataset):
    here = count_as_paper(dataset)
    assert (here.sequences, here.frames, here.units) == (3, 250, 2)
    assert here.hours == pytest.approx(250 * 0.02 / 3600)
    assert here.joints == 2
    assert (here.payloads_kg, here.rates_hz) == ((0, 0.2), (50,))


def test_repetitions_are_of_one_motion_unit_payload_and_rate(dataset, arm, tmp_path):
    """Three sequences that differ in motion, unit or payload are no repetitions."""
    assert count_as_paper(dataset).repetitions == 1
    assert count_as_paper(repeated_motions(tmp_path / "repeated", arm)).repetitions == 3


def test_signals_are_the_channels_of_every_sequence_without_the_command(arm, tmp_path):
    data = Dataset.create(tmp_path / "six", arm)
    ctrl = ramp(20, 0.3)
    derived = dict.fromkeys(("qacc", "tau", "tau_eq", "temperature"), 0 * ctrl)
    data.append(arm_sequence(arm, ctrl, ctrl, **derived))
    assert count_as_paper(data).signals == 6
    data.append(arm_sequence(arm, 2 * ctrl, ctrl, "without"))
    assert count_as_paper(data).signals == 2


def test_an_empty_dataset_has_no_counts(arm, tmp_path):
    with pytest.raises(DatasetError, match="sequences"):
        count_as_paper(Dataset.create(tmp_path / "empty", arm))


def test_the_card_beside_the_paper_has_both_counts_and_says_that_the_paper_s_do_not_reconcile(
    dataset,
):
    card = make_card(dataset) | {"beside_paper": beside_paper(dataset)}
    write_card(dataset, card)
    text = (dataset.path / "CARD.md").read_text(encoding="utf-8")
    assert "| sequences | 11,198 | 3 |" in text
    assert "| payloads, kg per hand | 0, 1, 2, 3 | 0, 0.2 |" in text
    assert "28.46 h at 50 Hz are 5.1 million frames" in text
    stored = json.loads((dataset.path / "card.json").read_text(encoding="utf-8"))["beside_paper"]
    assert (stored["paper"]["hours"], stored["here"]["frames"]) == (28.46, 250)
    assert "do not reconcile" in stored["note"]


def test_a_card_that_was_not_asked_for_the_paper_does_not_name_it(dataset):
    assert "paper" not in card_markdown(make_card(dataset))


def test_spread_over_repetitions_stands_on_the_page_joint_by_joint(arm, tmp_path):
    """States 2 mrad apart: their standard deviation is 2 mrad."""
    data = repeated_motions(tmp_path / "data", arm)
    ctrl = wave(120, 2, hertz=0.9)
    data.append(arm_sequence(arm, ctrl, ctrl, "m0"))
    text = card_markdown(make_card(data))
    assert "| shoulder | 0.002 |" in text
    assert "| elbow | 0.002 |" in text
    assert "1 sequences of these groups had another command" in text


def test_a_fleet_and_its_seed_stand_on_the_page(dataset):
    (dataset.path / "collect.json").write_text('{"fleet": "small", "seed": 7}')
    assert "fleet small, seed 7" in card_markdown(make_card(dataset))


def test_a_licence_that_was_stated_asks_for_nothing(dataset):
    dataset.set_provenance(licence="CC-BY-4.0", source="a laboratory")
    text = card_markdown(make_card(Dataset(dataset.path)))
    assert "- licence: CC-BY-4.0\n" in text
