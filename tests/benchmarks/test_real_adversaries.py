"""benchmarks/real_adversaries.py changes what it says and nothing else."""

import pytest
from logs import repeated_motions

from gaponet.experiments.real.questions import questions


def test_adversaries_change_what_is_learned_from_and_say_what_is_asked(arm, tmp_path, load):
    played = repeated_motions(tmp_path / "data", arm)
    (question,) = questions("new motions", played, arm, None)
    changed = {name: change(question) for name, change in load("real_adversaries").ADVERSARIES.items()}
    mixed = changed["labels"]
    assert sorted(s.meta.unit_id for s in mixed.fitted) == sorted(s.meta.unit_id for s in question.fitted)
    assert [s.meta.unit_id for s in mixed.fitted] != [s.meta.unit_id for s in question.fitted]
    was, later = question.test[0], changed["all_late"].test[0]
    rows = len(was) - len(later)
    assert rows * was.dt == pytest.approx(0.04)
    assert (later.ctrl == was.ctrl[rows:]).all()
    assert (later.qpos == was.qpos[:-rows]).all()
    assert sum(len(s) < len(was) for s in changed["late"].fitted) == -(-len(question.fitted) // 10)
    assert (changed["joints"].train[0].qpos == question.train[0].qpos[:, ::-1]).all()
    asked = changed["test_labels"]
    assert asked.train is question.train
    assert [s.meta.payload_mass for s in asked.test] != [s.meta.payload_mass for s in question.test]
    assert sorted(s.meta.payload_mass for s in asked.test) == sorted(s.meta.payload_mass for s in question.test)
    assert all(q.test is question.test for name, q in changed.items() if name not in ("all_late", "test_labels"))
