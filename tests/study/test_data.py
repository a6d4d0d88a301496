"""Error against hours: nested parts of the training motions, and how much is enough."""

import pytest

from gaponet.errors import UsageError
from gaponet.study.data import at, cells, result


def found(*mpjae):
    return [{"known": {"mpjae": v}, "seconds": 60.0} for v in mpjae]


def base(shares):
    return {s: {"nominal": found(0.010)[0], "delay_offset": found(0.008)[0]} for s in shares}


def test_all_of_the_data_is_the_model_as_it_is_and_shares_are_checked(make_study):
    study = make_study(seeds=1)
    assert [c.variant.name for c in cells(study, ("mlp",), (1.0, 0.5))] == ["mlp:train_share=0.5", "mlp"]
    with pytest.raises(UsageError, match=r"--shares 0 0\.5: give parts"):
        cells(study, ("mlp",), (0.0, 0.5))


@pytest.mark.parametrize(
    ("errors", "says"),
    [((0.004, 0.0022, 0.002), "and 0.40 with 15; 30 minutes come within 10 % of the whole."),
     ((0.004, 0.003, 0.002), "so more would help."), ((0.0021, 0.002, 0.002), "15 minutes come within")],
)  # fmt: skip
def test_the_least_that_comes_close_to_everything_is_enough(make_study, errors, says):
    shares = (0.25, 0.5, 1.0)
    data = {at("mlp", s): found(e) for s, e in zip(shares, errors, strict=True)}
    hours = dict(zip(shares, (0.25, 0.5, 1.0), strict=True))
    motions = dict(zip(shares, (1, 2, 4), strict=True))
    made = result(make_study(), ("mlp",), hours, motions, data, base(shares), [])
    assert made.sentences[0].startswith("mlp: 0.20 of the nominal error is left with 60 minutes of recordings")
    assert says in made.sentences[0]
    assert made.tables[0].texts()[2][:2] == ["4", "60.00"]
    assert [t.get_text() for t in made.figures["data"].axes[0].get_xticklabels()] == ["15", "30", "60"]
