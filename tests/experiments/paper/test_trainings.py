"""The list of trainings: equal for all networks, different where Table 2 says so."""

from dataclasses import replace

import pytest

from gaponet.experiments.paper.options import PaperOptions
from gaponet.experiments.paper.printed import TABLE_2
from gaponet.experiments.paper.tables import PRINTED_ROW
from gaponet.experiments.paper.trainings import (
    BLOCK_TITLES,
    NETWORKS,
    TABLE_2_CHANGES,
    all_trainings,
    block_title,
)

OPTIONS = PaperOptions(steps=100_000, seeds=3)
PAYLOADS = (0.0, 3.0)


@pytest.fixture
def trainings():
    return all_trainings(OPTIONS, (50.0, 100.0), PAYLOADS)


def of_block(trainings, block, seed=None):
    """The trainings of a block, of one seed or of all, in their order."""
    found = []
    for training in trainings:
        if training.block == block and seed in (None, training.seed):
            found.append(training)
    assert found
    return found


@pytest.mark.parametrize("block", ["labels", "ppo"])
@pytest.mark.parametrize("seed", range(3))
def test_networks_of_a_block_differ_in_their_kind_alone(trainings, block, seed):
    kinds = []
    alike = set()
    for training in of_block(trainings, block, seed):
        kinds.append(training.config.model.kind)
        model = replace(training.config.model, kind="gaponet")
        alike.add(replace(training.config, model=model))
    assert kinds == list(NETWORKS.values())
    assert len(alike) == 1


def test_every_network_of_the_claims_knows_the_payload(trainings):
    for training in trainings:
        assert training.config.model.payload_input or training.block == "table2"


def test_the_paper_s_recipe_has_no_labels_and_ours_has(trainings):
    for training in of_block(trainings, "ppo"):
        assert training.config.pretraining.rounds == 0
    for training in of_block(trainings, "labels"):
        assert training.config.pretraining.rounds > 0


@pytest.mark.parametrize(
    ("options", "title"),
    [
        (PaperOptions(steps=2 * 128 * 300), "labels alone"),  # rounds · simulators · steps
        (PaperOptions(steps=2 * 128 * 300 + 1), BLOCK_TITLES["labels"]),
        (PaperOptions(quick=True).for_quick_run(), BLOCK_TITLES["labels"]),
    ],
)
def test_a_block_whose_labels_take_all_steps_is_of_labels_alone(options, title):
    assert block_title("labels", options) == title


def test_all_trainings_of_a_block_are_equally_long(trainings):
    assert {training.steps for training in trainings} == {100_000}


def test_no_two_trainings_share_a_folder(trainings):
    assert len({training.folder for training in trainings}) == len(trainings)


def test_no_two_rows_of_table_2_share_a_configuration(trainings):
    rows = of_block(trainings, "table2", seed=0)
    assert len({row.config for row in rows}) == len(rows) == len(TABLE_2_CHANGES)


def test_each_row_of_table_2_observes_as_many_values_as_the_paper_prints(trainings):
    for training in trainings:
        if training.block == "table2" and training.name in PRINTED_ROW:
            printed = TABLE_2[PRINTED_ROW[training.name]]
            assert training.config.model.observation_dim(10) == printed.obs_dim


def test_a_dataset_of_one_rate_and_one_payload_has_no_rows_about_them():
    rows = {t.name for t in all_trainings(OPTIONS, (50.0,), (0.0,))}
    assert not {"100 Hz", "payload in"} & rows


def test_the_first_trainings_are_every_method_with_one_seed(trainings):
    assert [t.name for t in trainings[:4]] == list(NETWORKS)


def test_only_the_methods_and_blocks_that_are_asked_for_are_trained():
    options = replace(OPTIONS, methods=("GAPONet",), blocks=("ppo",))
    trainings = all_trainings(options, (50.0,), PAYLOADS)
    assert {(t.block, t.name) for t in trainings} == {("ppo", "GAPONet")}
