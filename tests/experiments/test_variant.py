"""A model with settings changed, as one word."""

import pytest

from gaponet.base.errors import UsageError
from gaponet.experiments.variant import KINDS, _read, parse_variant
from gaponet.nn.training.config import PretrainingConfig, TrainConfig

BASE = TrainConfig(pretraining=PretrainingConfig(rounds=7))


def test_settings_that_a_word_does_not_name_come_from_the_base():
    variant = parse_variant("mlp", BASE)
    assert variant.kind == "mlp"
    assert variant.config.pretraining.rounds == 7
    assert not variant.identified


def test_fields_of_model_and_training_are_changed():
    variant = parse_variant(
        "identified+mlp:mlp_hidden=256,128:payload_input=off:ppo.gamma=0.9:validate_every=3", BASE
    )
    assert variant.identified
    assert variant.config.model.mlp_hidden == (256, 128)
    assert variant.config.model.payload_input is False
    assert variant.config.ppo.gamma == 0.9
    assert variant.config.validate_every == 3
    assert variant.changes == (
        "mlp_hidden=256,128",
        "payload_input=off",
        "ppo.gamma=0.9",
        "validate_every=3",
    )


def test_every_kind_of_model_can_be_named():
    assert [parse_variant(kind, BASE).kind for kind in KINDS] == list(KINDS)


def test_a_field_that_may_be_absent_reads_none():
    assert _read("none", float | None, "here") is None
    assert _read("0.5", float | None, "here") == 0.5


@pytest.mark.parametrize(
    ("word", "complaint"),
    [
        ("lstm", "no model 'lstm'; there are gaponet, paper, shared_mlp"),
        ("mlp:hidden=3", "fields like that are .*mlp_hidden"),
        ("mlp:history", "'history' is not FIELD=VALUE"),
        ("mlp:kind=gaponet", "'kind=gaponet' is not"),
        ("mlp:seed=3", "'seed=3' is not"),
        ("mlp:history=many", "history is 'many': Input should be a valid integer"),
        ("mlp:mlp_hidden=a,b", "mlp_hidden is 'a,b': Input should be a valid integer"),
        ("gaponet:sensors=magic", "sensors is 'magic': Input should be 'off' or 'predicted'"),
        ("gaponet:history=0", "it must be positive"),
    ],
)
def test_an_invalid_word_is_refused_with_the_valid_ones(word, complaint):
    with pytest.raises(UsageError, match=complaint):
        parse_variant(word, BASE)
