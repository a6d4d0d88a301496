"""Every method has one name and one colour."""

from typing import get_args, get_type_hints

from gaponet.eval.evaluate import ORDER
from gaponet.methods import METHODS, colour, palette, shade, title
from gaponet.model.config import ModelConfig


def test_every_method_that_is_measured_has_a_name_and_a_colour_of_its_own():
    kinds = get_args(get_type_hints(ModelConfig)["kind"])
    for method in {*ORDER, *kinds, "target", "recorded", "raw", "feedforward"}:
        assert method in METHODS
    assert len({colour(m) for m in ORDER}) == len(ORDER)


def test_a_word_says_where_a_model_starts_and_what_is_changed_in_it():
    assert title("identified+gaponet") == "identification + GAPONet"
    assert title("mlp:mlp_match=on") == "MLP, full coupling, as many weights"
    assert title("gaponet:history=8:payload_input=off") == "GAPONet, mass not told (history 8)"
    assert title("someone's") == "someone's"


def test_a_method_has_the_colour_that_it_has_everywhere_and_its_variants_shades_of_it():
    found = palette(["mlp", "mlp:history=8", "new", "identified+mlp"])
    assert found["mlp"] == colour("mlp")
    assert len(set(found.values())) == 4
    light = {name: sum(int(c[i : i + 2], 16) for i in (1, 3, 5)) for name, c in found.items()}
    assert light["identified+mlp"] < light["mlp"] < light["mlp:history=8"]


def test_shades_are_nearer_to_white_or_to_black():
    assert shade("#804000", 0.5) == "#c0a080"
    assert shade("#804000", -0.5) == "#402000"
