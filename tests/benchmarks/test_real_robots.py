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
    cards, page = (
        read_cards(CARDS),
        (DOCS / "reference" / "recordings.md").read_text(encoding="utf-8"),
    )
    for card in cards.set:
        robot = load_robot(
            ROBOTS / card.robot if card.robot not in packaged_robots() else card.robot
        )
        assert set(card.joints) <= set(robot.joint_names)
        assert f"| {card.name} | {card.title} |" in page
        assert card.elsewhere in {"", *(c.name for c in cards.set)}


def test_only_adaptation_uses_recordings_of_a_unit_left_out_and_none_of_the_tested_motions(
    arm, played
):
    for question in questions("a unit left out", played, arm, None):
        (unit,) = {s.meta.unit_id for s in question.test}
        assert unit not in {s.meta.unit_id for s in question.train}
        assert {s.meta.unit_id for s in question.few} == {unit}
        assert not {s.meta.motion for s in question.few} & {s.meta.motion for s in question.test}
    with pytest.raises(UsageError, match="life"):
        list(questions("of life", played, arm, None))


def test_repetitions_count_as_one_motion_set_the_floor_and_are_evaluated_once(
    arm, played, tmp_path
):
    (question,) = questions("new motions", played, arm, None)
    assert repeatability(question) == pytest.approx(
        0.002 * 4 / 3, rel=1e-3
    )  # 1, 1 and 2 steps of 2 mrad
    methods = {k: METHODS[k] for k in ("nominal", "delay_offset")}
    card = next(c for c in read_cards().set if c.name == "so101")
    bench = Bench(read_cards(), tmp_path, tmp_path / "work", methods, say=lambda text: None)
    rows = bench.evaluate(card, "new motions", [question])
    assert [(r["motions"], r["recordings"]) for r in rows] == [(1, 6), (1, 6)]
    assert rows[0]["standard_error"] is None
    assert rows[1]["of_nominal"] < 1.0
    stopped = Bench(
        read_cards(),
        tmp_path,
        tmp_path / "work",
        dict.fromkeys(methods, ("", None)),
        say=lambda text: None,
    )
    again = stopped.evaluate(card, "new motions", [question])
    assert [r["mrad"] for r in again] == [r["mrad"] for r in rows]


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
    rows = [
        common
        | {
            "method": name,
            "mrad": np.mean(mrad),
            "by_motion_mrad": dict(zip("xyz", mrad, strict=True)),
        }
        for name, mrad in by_motion.items()
    ]
    assert [row[6] for row in result_table(rows).rows] == ["", "1.00 ± 0.00", "1.00 ± 1.00"]


def test_networks_are_trained_once_and_rejected_without_a_gain_over_identification(
    arm, played, tmp_path, monkeypatch
):
    monkeypatch.setattr(
        module,
        "ONE_ROUND",
        replace(module.ONE_ROUND, num_envs=12, gradient_steps=0, sensor_states=16),
    )
    (question,) = questions("new motions", played, arm, None)
    methods = {
        title: method
        for title, method in module.network_methods(240).values()
        if title.endswith("GAPONet")
    }
    with pytest.raises(UsageError, match="folder"):
        methods["GAPONet"](question)
    question = replace(question, work=tmp_path)
    save_robot(arm, tmp_path / "identified")
    beside, above = (method(question) for method in methods.values())
    assert beside.corrector is not None
    assert not beside.note.startswith(LEFT_OUT)
    assert (above.corrector, above.note.partition(":")[0]) == (None, LEFT_OUT)
    cards = [file.stat().st_mtime_ns for file in tmp_path.rglob("card.json")]
    assert len(cards) == 2
    again = methods["GAPONet"](question)
    assert again.note == beside.note
    assert cards == [file.stat().st_mtime_ns for file in tmp_path.rglob("card.json")]


def test_unknown_sets_and_questions_are_refused_and_absent_sets_skipped(tmp_path):
    bench = Bench(read_cards(), tmp_path, tmp_path / "work", METHODS, say=lambda text: None)
    for only, asked, told in (
        (("a robot",), (), "no set 'a robot'"),
        ((), ("why",), "no question 'why'"),
    ):
        with pytest.raises(UsageError, match=told):
            bench.run(only, asked)
    assert bench.run()["rows"] == []


def test_the_method_on_the_page_runs(arm, played, tmp_path):
    code = re.search(
        r"```python\n(.*?)```", (DOCS / "benchmark.md").read_text(encoding="utf-8"), re.DOTALL
    )[1]
    (tmp_path / "mine.py").write_text(code)
    name, method = load_method(f"{tmp_path / 'mine.py'}:late_targets")
    (question,) = questions("new motions", played, arm, None)
    moved = method(question).positions(question.test)
    assert name == "late_targets"
    assert [q.shape for q in moved] == [s.qpos.shape for s in question.test]
    with pytest.raises(UsageError, match="FUNCTION"):
        load_method("nothing.py:f")


def test_a_failing_method_loses_its_own_row_and_single_joints_have_errors_by_payload(
    arm, played, tmp_path
):
    alone = Dataset.create(tmp_path / "alone", arm)
    for e in played.entries:
        one = played.read(e)
        alone.append(
            replace(one, meta=replace(one.meta, notes={"held_at_home": [arm.operated[1]]}))
        )
    (question,) = questions("0.5 kg left out", alone, arm, None)
    said, methods = [], {"nominal": METHODS["nominal"], "mine": ("mine", lambda question: 1 / 0)}
    bench = Bench(read_cards(), tmp_path, tmp_path / "work", methods, say=said.append)
    card = next(c for c in read_cards().set if c.name == "so101")
    (row,) = bench.evaluate(card, question.name, [question])
    assert any("mine: ZeroDivisionError" in text for text in said)
    ((mrad, count),) = row["by_joint_mrad"][arm.operated[0]].values()
    assert (mrad, count) == (pytest.approx(row["mrad"]), 12)
