"""Every method has one name and one colour."""

from typing import get_args, get_type_hints

from gaponet.nn.config import ModelConfig
from gaponet.report.evaluate import ORDER
from gaponet.report.methods import METHODS, colour, palette, shade, title


def test_every_method_that_is_measured_has_a_name():
    kinds = get_args(get_type_hints(ModelConfig)["kind"])
    for method in {*ORDER, *kinds, "target", "recorded", "raw", "feedforward"}:
        assert method in METHODS


def test_the_title_of_a_word_names_start_and_changed_settings():
    assert title("identified+gaponet") == "identification + GAPONet"
    assert title("mlp:mlp_match=on") == "MLP, full coupling, as many weights"
    assert title("gaponet:history=8:payload_input=off") == "GAPONet, payload unobserved (history 8)"
    assert title("someone's") == "someone's"


def test_every_method_that_is_measured_has_a_colour_of_its_own():
    assert len({colour(m) for m in ORDER}) == len(ORDER)


def test_variants_of_a_method_have_shades_of_its_colour():
    colours = palette(["mlp", "mlp:history=8", "new", "identified+mlp"])
    assert colours["mlp"] == colour("mlp")
    assert len(set(colours.values())) == 4
    light = {name: sum(int(c[i : i + 2], 16) for i in (1, 3, 5)) for name, c in colours.items()}
    assert light["identified+mlp"] < light["mlp"] < light["mlp:history=8"]
    assert (shade("#804000", 0.5), shade("#804000", -0.5)) == ("#c0a080", "#402000")
