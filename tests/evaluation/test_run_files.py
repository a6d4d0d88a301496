"""A run folder's files are read as they were written, and refused in one line with file and field
otherwise.
"""

import json

import numpy as np
import pytest

from gaponet.base.errors import ModelError
from gaponet.evaluation.run_files import (
    read_config,
    read_gap,
    read_metrics,
    read_progress,
    read_trajectories,
)

PART = {"mpjae": 0.01}
JOINT = PART | {"static": 0.01, "dynamic": 0.01}
SCORES = dict.fromkeys(
    ("mpjae", "rmse", "q_dis", "static", "dynamic", "large_0.05", "large_0.1"), 0.01
) | {
    "correlation": None,
    "by_joint": {"elbow": JOINT},
    "by_payload": {"0.5": PART},
    "by_motion": {"wave": PART},
    "by_independent_motion": {"wave": PART},
    "by_horizon": {"1": PART, "whole": PART},
}
METRICS = {
    "methods": {"nominal": SCORES, "gaponet": SCORES},
    "ratio_to_nominal": {"nominal": 1.0, "gaponet": 0.5},
    "dataset": "d",
    "sequences": 1,
    "motions": ["wave"],
    "unseen": True,
    "virtual": False,
    "robot": "arm",
    "simulator_hash": "0123",
    "delta": {"gaponet": {"max": 0.1, "mean": 0.1}},
    "artifacts": {"gaponet": {"weights": "0123", "seed": 0}},
    "shown": [{"motion": "wave", "unit_id": "a", "payload_mass": 0.5, "dt": 0.02}],
}


def changed(*path, value):
    """METRICS with one field changed."""
    new = json.loads(json.dumps(METRICS))
    place = new
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return new


def test_absent_numbers_are_nan_and_unknown_fields_are_kept(tmp_path):
    (tmp_path / "metrics.json").write_text(json.dumps(METRICS | {"new": 1}))
    metrics = read_metrics(tmp_path)
    assert np.isnan(metrics["methods"]["nominal"]["correlation"])
    assert metrics["new"] == 1


@pytest.mark.parametrize(
    ("metrics", "said"),
    [
        (changed("methods", "nominal", "mpjae", value="<b>"), r"methods\.nominal\.mpjae:"),
        (changed("methods", "<script>", value=SCORES), r"methods\.<script>"),
        (
            changed("methods", "gaponet", "by_joint", value={"wing": JOINT}),
            r"methods\.gaponet\.by_joint:",
        ),
        (changed("methods", value={"gaponet": SCORES}), "methods: nominal"),
        (
            changed("methods", "gaponet", "by_joint", value={"elbow": {}}),
            r".*by_joint\.elbow\.mpjae:",
        ),
        (changed("sequences", value="<b>7</b>"), "sequences:"),
        (changed("simulator_hash", value=None), "simulator_hash:"),
        (changed("shown", value=[{}]), r"shown\[0\]\.motion:"),
        (changed("shown", 0, "dt", value=1e-9), r"shown\[0\]\.dt:"),
    ],
)
def test_damaged_metrics_are_refused(tmp_path, metrics, said):
    (tmp_path / "metrics.json").write_text(json.dumps(metrics))
    with pytest.raises(ModelError, match=rf"metrics\.json: {said}"):
        read_metrics(tmp_path)


@pytest.mark.parametrize(
    "bad", [np.zeros((5, 3)), np.zeros(5), np.full((5, 2), np.nan), np.zeros((4, 2))]
)
def test_trajectories_of_other_sizes_are_refused(tmp_path, bad):
    good = np.zeros((5, 2), np.float32)
    np.savez(
        tmp_path / "trajectories.npz",
        **{f"0/{m}": good for m in ("recorded", "command", "nominal")},
        **{"0/gaponet": bad.astype(np.float32)},
    )
    with pytest.raises(ModelError, match=r"trajectories\.npz: "):
        read_trajectories(tmp_path, METRICS, 2)


def test_an_incomplete_last_validation_is_skipped(tmp_path):
    line = {
        "stage": "ppo",
        "steps": 1,
        "seconds": 0.5,
        "reward": None,
        "val_mpjae": 0.1,
        "nominal_mpjae": 0.2,
    }
    (tmp_path / "progress.jsonl").write_text(json.dumps(line) + "\n" + json.dumps(line)[:20])
    assert read_progress(tmp_path) == [line]
    (tmp_path / "progress.jsonl").write_text(json.dumps(line | {"steps": "x"}) + "\n")
    with pytest.raises(ModelError, match=r"progress\.jsonl:1: steps"):
        read_progress(tmp_path)


def test_a_config_and_a_gap_of_another_kind_are_refused(tmp_path):
    (tmp_path / "config.json").write_text('{"model": {"kind": "gaponet"}, "seed": 0}')
    with pytest.raises(ModelError, match=r"config\.json: ppo"):
        read_config(tmp_path)
    assert read_gap(tmp_path) is None
    (tmp_path / "gap.json").write_text('{"left": {"<b>": 1}}')
    with pytest.raises(ModelError, match=r"gap\.json: "):
        read_gap(tmp_path)
