"""The benchmark of real robots: what it asks, what it counts, and how somebody adds a method."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from logs import repeated_motions
from real_robots import methods as module
from real_robots.bench import Bench, load_method
from real_robots.cards import CARDS, ROBOTS, read_cards
from real_robots.methods import LEFT_OUT, METHODS
from real_robots.page import result_table
from real_robots.questions import questions, repeatability

from gaponet.base.errors import UsageError
from gaponet.data.store import Dataset
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot, packaged_robots

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture
def played(arm, tmp_path):
    return repeated_motions(tmp_path / "data", arm)


def test_every_card_has_an_existing_robot_and_a_row_on_the_page():
    cards = read_cards(CARDS)
    page = (DOCS / "reference" / "recordings.md").read_text(encoding="utf-8")
    for card in cards.set:
        packaged = card.robot in packaged_robots()
        robot = load_robot(card.robot if packaged else ROBOTS / card.robot)
        assert set(card.joints) <= set(robot.joint_names)
        assert f"| {card.name} | {card.title} |" in page
        assert card.elsewhere in {"", *(c.name for c in cards.set)}


def units_of(sequences):
    return {s.meta.unit_id for s in sequences}


def motions_of(sequences):
    return {s.meta.motion for s in sequences}


def test_only_adaptation_uses_recordings_of_a_unit_left_out_and_none_of_the_tested_motions(
    arm, played
):
    for question in questions("a unit left out", played, arm, None):
        (unit,) = units_of(question.test)
        assert unit not in units_of(question.train)
        assert units_of(question.few) == {unit}
        assert not motions_of(question.few) & motions_of(question.test)


def test_an_unknown_question_is_refused(arm, played):
    with pytest.raises(UsageError, match="life"):
        list(questions("of life", played, arm, None))


def test_repetitions_of_a_motion_set_the_floor(arm, played):
    (question,) = questions("new motions", played, arm, None)
    floor = 0.002 * 4 / 3  # 1, 1 and 2 steps of 2 mrad
    assert repeatability(question) == pytest.approx(floor, rel=1e-3)


def card_of(name):
    return next(card for card in read_cards().set if card.name == name)


def bench_of(methods, folder, say=lambda text: None):
    return Bench(read_cards(), folder, folder / "work", methods, say=say)


def test_repetitions_count_as_one_motion_and_are_evaluated_once(arm, played, tmp_path):
    (question,) = questions("new motions", played, arm, None)
    methods = {name: METHODS[name] for name in ("nominal", "delay_offset")}
    card = card_of("so101")
    nominal, shifted = bench_of(methods, tmp_path).evaluate(card, "new motions", [question])
    for row in (nominal, shifted):
        assert row["motions"] == 1
        assert row["recordings"] == 6
    assert nominal["standard_error"] is None
    assert shifted["of_nominal"] < 1.0
    none_runs = dict.fromkeys(methods, ("", None))
    again = bench_of(none_runs, tmp_path).evaluate(card, "new motions", [question])
    assert [row["mrad"] for row in again] == [nominal["mrad"], shifted["mrad"]]


def test_the_table_has_paired_differences_to_identification_over_motions():
    common = {
        "set": "a",
        "question": "b",
        "standard_error": 0.5,
        "of_nominal": 0.5,
        "less_than_nominal": 0.0,
        "floor_mrad": None,
        "motions": 3,
    }
    by_motion = {
        "identification": [1.0, 2.0, 9.0],
        "rival": [2.0, 3.0, 10.0],
        "another": [1.0, 2.0, 12.0],
    }
    rows = []
    for name, mrad in by_motion.items():
        of_motions = dict(zip("xyz", mrad, strict=True))
        rows.append(common | {"method": name, "mrad": np.mean(mrad), "by_motion_mrad": of_motions})
    assert [row[6] for row in result_table(rows).rows] == ["", "1.00 ± 0.00", "1.00 ± 1.00"]


@pytest.fixture
def networks(monkeypatch):
    """Methods that train a network in seconds: beside the nominal robot, above identification."""
    quick = replace(module.ONE_ROUND, num_envs=12, gradient_steps=0, sensor_states=16)
    monkeypatch.setattr(module, "ONE_ROUND", quick)
    every = dict(module.network_methods(240).values())
    return {title: method for title, method in every.items() if title.endswith("GAPONet")}


def test_a_network_needs_a_folder_for_what_it_trains(arm, played, networks):
    (question,) = questions("new motions", played, arm, None)
    with pytest.raises(UsageError, match="folder"):
        networks["GAPONet"](question)


def times_of_cards(folder):
    return [file.stat().st_mtime_ns for file in folder.rglob("card.json")]


def test_networks_are_trained_once_and_rejected_without_a_gain_over_identification(
    arm, played, tmp_path, networks
):
    (question,) = questions("new motions", played, arm, None)
    question = replace(question, work=tmp_path)
    save_robot(arm, tmp_path / "identified")
    beside, above = (method(question) for method in networks.values())
    assert beside.corrector is not None
    assert not beside.note.startswith(LEFT_OUT)
    assert above.corrector is None
    assert above.note.partition(":")[0] == LEFT_OUT
    trained = times_of_cards(tmp_path)
    assert len(trained) == 2
    again = networks["GAPONet"](question)
    assert again.note == beside.note
    assert times_of_cards(tmp_path) == trained


@pytest.mark.parametrize(
    ("sets", "asked", "told"),
    [(("a robot",), (), "no set 'a robot'"), ((), ("why",), "no question 'why'")],
)
def test_unknown_sets_and_questions_are_refused(tmp_path, sets, asked, told):
    with pytest.raises(UsageError, match=told):
        bench_of(METHODS, tmp_path).run(sets, asked)


def test_absent_sets_are_skipped(tmp_path):
    assert bench_of(METHODS, tmp_path).run()["rows"] == []


def test_the_method_on_the_page_runs(arm, played, tmp_path):
    page = (DOCS / "benchmark.md").read_text(encoding="utf-8")
    code = re.search(r"```python\n(.*?)```", page, re.DOTALL)[1]
    (tmp_path / "mine.py").write_text(code)
    name, method = load_method(f"{tmp_path / 'mine.py'}:late_targets")
    (question,) = questions("new motions", played, arm, None)
    moved = method(question).positions(question.test)
    assert name == "late_targets"
    assert [q.shape for q in moved] == [s.qpos.shape for s in question.test]


def test_a_method_that_is_not_there_is_refused():
    with pytest.raises(UsageError, match="FUNCTION"):
        load_method("nothing.py:f")


def test_a_failing_method_loses_its_own_row_and_single_joints_have_errors_by_payload(
    arm, played, tmp_path
):
    alone = Dataset.create(tmp_path / "alone", arm)
    held = {"held_at_home": [arm.operated[1]]}
    for entry in played.entries:
        one = played.read(entry)
        alone.append(replace(one, meta=replace(one.meta, notes=held)))
    (question,) = questions("0.5 kg left out", alone, arm, None)
    said = []
    methods = {"nominal": METHODS["nominal"], "mine": ("mine", lambda question: 1 / 0)}
    bench = bench_of(methods, tmp_path, said.append)
    (row,) = bench.evaluate(card_of("so101"), question.name, [question])
    assert any("mine: ZeroDivisionError" in text for text in said)
    assert bench.failed == ["so101, 0.5 kg left out, mine"]
    ((mrad, count),) = row["by_joint_mrad"][arm.operated[0]].values()
    assert mrad == pytest.approx(row["mrad"])
    assert count == 12
