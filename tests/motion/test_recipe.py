"""Recipes from strangers: types, ranges and sizes, refused with file and field."""

import pytest

from gaponet.base.errors import UsageError
from gaponet.motion.recipe import load_recipe, takes

GOOD = 'payloads = [0.0]\nunits = ["a"]\nmotions = ["x"]\n'


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("[0.0]", "[nan]", r"payloads\[0\]: "),
        ("[0.0]", "[-1.0]", r"payloads\[0\]: should be greater than or equal to 0"),
        ("[0.0]", "[1e30]", r"payloads\[0\]: should be less than or equal to 100"),
        ("[0.0]", "0.0", "payloads: should be a valid "),
        ('["a"]', "[3]", r"units\[0\]: should be a valid string"),
        ("motions", "rates = [0]\nmotions", r"rates\[0\]: should be greater than or equal to 1"),
        ("motions", "rates = [1e9]\nmotions", r"rates\[0\]: should be less than or equal to 10000"),
        (
            "motions",
            "repetitions = 1000000000\nmotions",
            "repetitions: should be less than or equal to 10000",
        ),
        ("motions", "variants = true\nmotions", "variants: should be a valid integer"),
        ("motions", "units2 = 3\nmotions", "units2: is not a known field"),
    ],
)
def test_a_recipe_that_cannot_be_played_is_refused_by_field(tmp_path, old, new, complaint):
    (tmp_path / "mine.toml").write_text(GOOD.replace(old, new, 1))
    with pytest.raises(UsageError, match=rf"mine\.toml: {complaint}"):
        load_recipe(tmp_path / "mine.toml")


def test_a_recipe_with_too_many_sequences_is_refused(tmp_path):
    units = ", ".join(f'"u{i}"' for i in range(200))
    (tmp_path / "mine.toml").write_text(GOOD.replace('"a"', units) + "repetitions = 10000\n")
    with pytest.raises(UsageError, match="2000000 sequences; at most 1000000 in one recipe"):
        takes(load_recipe(tmp_path / "mine.toml"), ["x"])
