"""Leave one unit out: folds of their own, and what is said about numbers worked by hand."""

import pytest

from gaponet.base.errors import UsageError
from gaponet.experiments.unit import Unit, seen, units_of


def found(new, **known):
    return {"known": {"by_unit": {u: {"mpjae": v} for u, v in known.items()}}, "new": {"mpjae": new}, "seconds": 60.0}


def test_every_unit_is_left_out_once_in_a_folder_of_its_own(make_study):
    made = Unit(("mlp",)).cells(make_study(seeds=2))
    assert [c.holdout_units for c in made] == [("a",), ("a",), ("b",), ("b",)]
    assert made[3].folder.parts[-3:] == ("without-b", "cells", "mlp-1")


def test_one_unit_cannot_be_left_out(make_study):
    with pytest.raises(UsageError, match=r"one unit only \(a\)"):
        units_of(make_study(units=("a",)).data)


def test_a_unit_is_known_in_the_folds_that_left_out_another(make_study, make_found):
    runs = {("mlp", "a"): [found(0.004, b=0.002)], ("mlp", "b"): [found(0.005, a=0.001), found(0.007, a=0.003)]}
    folds = make_found(runs, {"nominal": found(0.010), "delay_offset": found(0.008)})
    assert seen(folds, "a", "mlp").mean == pytest.approx(2.0)
    assert seen(folds, "b", "mlp").count == 1
    made = Unit(("mlp",)).result(make_study(), folds)
    texts = made.tables[0].texts()
    assert texts[1] == ["b", "10.00", "8.00", "6.00 ± 1.41", "2.00", "0.60 ± 0.14"]
    assert texts[2][3] == "5.00 ± 1.41"  # 4 and 6: over units
    assert made.sentences == (
        "MLP, full coupling leaves 0.50 of the nominal error on a unit never seen and 0.20 on the same units when "
        "trained on.",
    )


def test_a_model_that_is_worse_than_nominal_is_called_so_and_two_are_compared_unit_by_unit(make_study, make_found):
    runs = {("mlp", "a"): [found(0.012, b=0.002)], ("gaponet", "a"): [found(0.006, b=0.002)],
            ("mlp", "b"): [found(0.004, a=0.001)], ("gaponet", "b"): [found(0.004, a=0.003)]}  # fmt: skip
    folds = make_found(runs, {"nominal": found(0.010), "delay_offset": found(0.008)})
    sentences = Unit(("gaponet", "mlp")).result(make_study(), folds).sentences
    assert sentences[1].endswith("; it is worse than nominal on 1 of 2.")
    assert "GAPONet leaves 0.75 ± 0.35 of the error of MLP, full coupling (over units), less on 1 of 2." in sentences[2]
