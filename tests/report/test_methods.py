"""Every method has one name."""

from typing import get_args, get_type_hints

from gaponet.nn.config import ModelConfig
from gaponet.report.evaluate import ORDER
from gaponet.report.methods import METHODS, title


def test_every_method_that_is_measured_has_a_name():
    kinds = get_args(get_type_hints(ModelConfig)["kind"])
    for method in {*ORDER, *kinds, "target", "recorded", "raw", "feedforward"}:
        assert method in METHODS


def test_a_word_says_where_a_model_starts_and_what_is_changed_in_it():
    assert title("identified+gaponet") == "identification + GAPONet"
    assert title("mlp:mlp_match=on") == "MLP, full coupling, as many weights"
    assert title("gaponet:history=8:payload_input=off") == "GAPONet, mass not told (history 8)"
    assert title("someone's") == "someone's"
