"""Every method has one name and one colour."""

from typing import get_args, get_type_hints

from gaponet.evaluation.evaluate import ORDER
from gaponet.evaluation.methods import METHODS, colour, shade, title
from gaponet.nn.config import ModelConfig


def test_every_method_that_is_measured_has_a_name():
    kinds = get_args(get_type_hints(ModelConfig)["kind"])
    for method in {*ORDER, *kinds, "target", "recorded"}:
        assert method in METHODS


def test_a_title_names_the_identified_simulator_that_a_network_corrects():
    assert title("identified+gaponet") == "identification + GAPONet"
    assert title("someone's") == "someone's"


def test_every_method_that_is_measured_has_a_colour_of_its_own():
    assert len({colour(m) for m in ORDER}) == len(ORDER)


def test_a_network_on_an_identified_simulator_has_a_darker_colour():
    def light(colour):
        return sum(int(colour[i : i + 2], 16) for i in (1, 3, 5))

    assert light(colour("identified+mlp")) < light(colour("mlp"))


def test_a_colour_is_mixed_with_white_or_with_black():
    assert shade("#804000", 0.5) == "#c0a080"
    assert shade("#804000", -0.5) == "#402000"
