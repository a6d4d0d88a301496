"""Recipes from strangers: types, ranges and sizes, refused with file and field."""

import pytest

from gaponet.base.errors import UsageError
from gaponet.motion.recipe import load_recipe, takes

GOOD = 'payloads = [0.0]\nunits = ["a"]\nmotions = ["x"]\n'


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("[0.0]", "[nan]", r"payloads\[0\]: "),
        ("[0.0]", "[-1.0]", r"payloads\[0\]:"),
        ("[0.0]", "[1e30]", r"payloads\[0\]:"),
        ("[0.0]", "0.0", "payloads:"),
        ('["a"]', "[3]", r"units\[0\]:"),
        ("motions", "rates = [0]\nmotions", r"rates\[0\]:"),
        ("motions", "rates = [1e9]\nmotions", r"rates\[0\]:"),
        ("motions", "repetitions = 1000000000\nmotions", "repetitions:"),
        ("motions", "variants = true\nmotions", "variants:"),
        ("motions", "units2 = 3\nmotions", "units2:"),
    ],
)
def test_a_recipe_that_cannot_be_played_is_refused_by_field(tmp_path, old, new, complaint):
    (tmp_path / "mine.toml").write_text(GOOD.replace(old, new, 1))
    with pytest.raises(UsageError, match=rf"mine\.toml: {complaint}"):
        load_recipe(tmp_path / "mine.toml")


def test_a_recipe_with_too_many_sequences_is_refused(tmp_path):
    units = ", ".join(f'"u{i}"' for i in range(200))
    (tmp_path / "mine.toml").write_text(GOOD.replace('"a"', units) + "repetitions = 10000\n")
    with pytest.raises(UsageError, match="2000000"):
        takes(load_recipe(tmp_path / "mine.toml"), ["x"])
