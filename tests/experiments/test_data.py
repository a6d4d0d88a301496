"""Error against hours: nested parts of the training motions, and how much is enough."""

import json
from types import SimpleNamespace

import pytest

from gaponet.base.errors import UsageError
from gaponet.experiments.data import Data, at


def found(*mpjae):
    return [{"known": {"mpjae": v}, "seconds": 60.0} for v in mpjae]


def test_all_of_the_data_is_the_model_as_it_is_and_shares_are_checked(make_study):
    study = make_study(seeds=1)
    assert [c.variant.name for c in Data(("mlp",), (1.0, 0.5)).cells(study)] == ["mlp:train_share=0.5", "mlp"]
    with pytest.raises(UsageError, match=r"--shares 0 0\.5: give parts"):
        Data(("mlp",), (0.0, 0.5)).cells(study)


@pytest.mark.parametrize(
    ("errors", "says"),
    [((0.004, 0.0022, 0.002), "and 0.40 with 15; 30 minutes come within 10 % of the whole."),
     ((0.004, 0.003, 0.002), "so more would help."), ((0.0021, 0.002, 0.002), "15 minutes come within")],
)  # fmt: skip
def test_the_least_that_comes_close_to_everything_is_enough(make_study, make_found, tmp_path, errors, says):
    shares = (0.25, 0.5, 1.0)
    runs = {at("mlp", s): found(e) for s, e in zip(shares, errors, strict=True)}
    cells = {}
    for word, share in zip(runs, shares, strict=True):
        folder = tmp_path / f"{share}" / "model"
        folder.mkdir(parents=True)
        card = {"hours": share, "motions": {"train": ["m"] * round(4 * share)}}
        (folder / "card.json").write_text(json.dumps(card))
        cells[word, ""] = [SimpleNamespace(folder=folder.parent)]
    base = {"nominal": found(0.010)[0], "delay_offset": found(0.008)[0]}
    made = Data(("mlp",), shares).result(make_study(), make_found(runs, base, cells))
    assert made.sentences[0].startswith(
        "MLP, full coupling: 0.20 of the nominal error is left with 60 minutes of recordings"
    )
    assert says in made.sentences[0]
    assert made.tables[0].texts()[2][:2] == ["4", "60.00"]
    assert [t.get_text() for t in made.figures["data"].axes[0].get_xticklabels()] == ["15", "30", "60"]
