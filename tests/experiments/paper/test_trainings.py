"""The list of trainings: equal for all networks, different where Table 2 says so."""

from dataclasses import replace

import pytest

from gaponet.experiments.paper.options import PaperOptions
from gaponet.experiments.paper.printed import TABLE_2
from gaponet.experiments.paper.tables import PRINTED_ROW
from gaponet.experiments.paper.trainings import NETWORKS, TABLE_2_CHANGES, all_trainings

OPTIONS = PaperOptions(steps=100_000, seeds=3)
PAYLOADS = (0.0, 3.0)


@pytest.fixture
def trainings():
    return all_trainings(OPTIONS, (50.0, 100.0), PAYLOADS)


@pytest.mark.parametrize("block", ["labels", "ppo"])
def test_networks_of_a_block_differ_in_their_kind_alone(trainings, block):
    for seed in range(3):
        configs = [t.config for t in trainings if (t.block, t.seed) == (block, seed)]
        kinds = [config.model.kind for config in configs]
        assert kinds == list(NETWORKS.values())
        alike = {replace(c, model=replace(c.model, kind="gaponet")) for c in configs}
        assert len(alike) == 1


def test_every_network_of_the_claims_knows_the_payload(trainings):
    assert all(t.config.model.payload_input for t in trainings if t.block != "table2")


def test_the_paper_s_recipe_has_no_labels_and_ours_has(trainings):
    assert all(t.config.pretraining.rounds == 0 for t in trainings if t.block == "ppo")
    assert all(t.config.pretraining.rounds > 0 for t in trainings if t.block == "labels")


def test_all_trainings_of_a_block_are_equally_long(trainings):
    assert {t.steps for t in trainings} == {100_000}


def test_no_two_trainings_share_a_folder_or_a_configuration(trainings):
    assert len({t.folder for t in trainings}) == len(trainings)
    rows = [t for t in trainings if t.block == "table2" and t.seed == 0]
    assert len({t.config for t in rows}) == len(rows) == len(TABLE_2_CHANGES)


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
