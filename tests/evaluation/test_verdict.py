"""Sentences about the errors of methods."""

import numpy as np
import pytest

from gaponet.evaluation.verdict import network_gain, verdict


def scores(*errors, motions):
    by_motion = {f"chirp@{i}": {"mpjae": e} for i, e in enumerate(errors)}
    independent = {}
    for i, group in enumerate(np.array_split(errors, motions)):
        independent[f"chirp{i}"] = {"mpjae": float(np.mean(group))}
    return {
        "mpjae": float(np.mean(errors)),
        "by_joint": {"elbow": {"mpjae": 1.0}},
        "by_motion": by_motion,
        "by_independent_motion": independent,
    }


@pytest.mark.parametrize(
    ("motions", "words"), [(1, "1.00 mrad (one motion)"), (2, "1.00 ± 0.50 mrad")]
)
def test_pieces_of_one_motion_have_no_standard_error(motions, words):
    before = scores(5e-3, 5e-3, 6e-3, 6e-3, motions=motions)
    after = scores(4.5e-3, 4.5e-3, 4.5e-3, 4.5e-3, motions=motions)
    methods = {"nominal": before, "identified": before, "identified+mlp": after}
    assert network_gain(methods, "identified+mlp").reduction == pytest.approx(1e-3)
    assert words in verdict(methods)[-1]
    assert f"{motions} independent motion" in verdict(methods)[1]
