"""Claims and tables from result files that were made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from gaponet.experiments.paper.claims import claim_table, claims
from gaponet.experiments.paper.options import PaperOptions
from gaponet.experiments.paper.results import Results
from gaponet.experiments.paper.tables import commands_table, table_1, table_2

PAYLOADS = [0.0, 3.0, 0.0, 3.0]
RAW = np.array([[0.2, 0.2], [0.4, 0.4], [0.2, 0.2], [0.4, 0.4]])  # (recordings, joints) rad·s
OFFSET = np.full((2, 4, 3), 0.02)  # (payloads, goals, axes) m


def commands(share):
    ways = {"raw": RAW, "feedforward": 0.5 * RAW, "integral": 0.4 * RAW}
    return {way: (share * q_dis).tolist() for way, q_dis in ways.items()}


def delivery(share):
    return {
        "raw": {"offset": (share * OFFSET).tolist()},
        "feedforward": {"offset": (share * 0.1 * OFFSET).tolist()},
        "integral": {"offset": (share * 0.1 * OFFSET).tolist()},
    }


def alignment(share):
    return {"q_dis": (share * RAW).tolist(), "large_gaps": {"0.1": [0.0] * 4, "0.5": [0.0] * 4}}


def training(name, share, block="labels", seed=0):
    by_way = commands(share)
    by_hand = delivery(share)
    return {
        "block": block,
        "name": name,
        "seed": seed,
        "obs_dim": 141,
        "alignment": alignment(share),
        "commands": {
            "delta": by_way["raw"],
            "both": by_way["feedforward"],
            "integral": by_way["integral"],
        },
        "delivery": {
            "delta": by_hand["raw"],
            "both": by_hand["feedforward"],
            "integral": by_hand["integral"],
        },
    }


def make_results(*trainings, options=PaperOptions()):  # noqa: B008
    robot = SimpleNamespace(operated=("shoulder", "elbow"))
    study = SimpleNamespace(virtual=True, delivers=True, robot=robot, options=options)
    baselines = {
        "motions": ["a", "a", "b", "b"],
        "payloads": PAYLOADS,
        "durations_s": [2.0, 2.0, 2.0, 2.0],
        "nominal": {
            "alignment": alignment(1.0),
            "commands": commands(1.0),
            "delivery": delivery(1.0),
        },
        "identified": {"alignment": alignment(0.5), "commands": commands(0.9)},
    }
    return Results(study, baselines, list(trainings))  # type: ignore[arg-type]


def test_networks_have_zero_percent_in_every_claim_if_all_are_untrained():
    found = claims(make_results(training("MLP", 1.0), training("GAPONet", 1.0)))
    assert len(found) > 10
    for claim in found:
        for name, reduction in claim.reductions.items():
            if name != "identification":
                assert reduction.mean == pytest.approx(0.0), claim.text


def test_a_network_that_halves_every_error_has_fifty_percent_in_every_claim():
    found = claims(make_results(training("MLP", 1.0), training("GAPONet", 0.5)))
    for claim in found:
        assert claim.reductions["GAPONet"].mean == pytest.approx(50.0), claim.text


def test_every_network_is_compared_with_the_mlp_on_the_same_recordings():
    found = claims(make_results(training("MLP", 0.8), training("GAPONet", 0.4)))
    (claim,) = [claim for claim in found if claim.text.endswith("less Q_dis than the MLP")]
    assert claim.reductions.keys() == {"GAPONet"}
    assert claim.reductions["GAPONet"].mean == pytest.approx(50.0)


def test_seeds_of_which_one_training_failed_are_not_compared():
    trainings = [training("MLP", 0.8, seed=1), training("GAPONet", 0.1), training("literal", 0.1)]
    found = claims(make_results(*trainings, training("GAPONet", 0.4, seed=1)))
    for claim in found:
        if claim.text.endswith("than the MLP"):
            assert claim.reductions.keys() == {"GAPONet"}
            assert claim.reductions["GAPONet"].mean == pytest.approx(50.0)


def test_the_paper_s_numbers_stand_beside_its_own_claims_alone():
    found = claims(make_results(training("MLP", 1.0), training("GAPONet", 0.5)))
    printed = [claim.printed for claim in found if claim.printed is not None]
    assert sorted(printed) == [40, 40, 40, 40, 50, 50, 70]


def test_no_method_of_a_block_is_missing_from_its_table():
    networks = ("MLP", "shared MLP", "literal", "GAPONet")
    found = claims(make_results(*[training(network, 0.9) for network in networks]))
    table = claim_table(found, "labels", "labels, then PPO")
    assert table.columns[2:-1] == ("identification", *networks)


def test_the_gain_of_a_network_on_the_robot_is_over_the_same_way_without_it():
    table = commands_table(make_results(training("GAPONet", 0.5)), "labels")
    both = next(row for row in table.rows if row[0].startswith("GAPONet: feed-forward and"))
    # Against raw: half by the feed-forward, half of the rest.
    assert both[2].mean == pytest.approx(75.0)
    assert both[3].mean == pytest.approx(50.0)


def test_tables_say_when_identification_fitted_each_joint_alone():
    hurried = make_results(options=PaperOptions(identify_windows=8))
    rows = [row[0] for row in commands_table(hurried, "labels").rows]
    assert "feed-forward, identification, each joint alone" in rows


def test_table_1_has_every_payload_way_and_method_beside_the_paper_s():
    table = table_1(make_results(training("GAPONet", 0.5)), "labels")
    rows = [row[0] for row in table.rows]
    assert "3 kg, targets as they are" in rows
    assert "3 kg, GAPONet: target − Δa" in rows
    assert "3 kg, the paper's GAPONet" in rows
    raw = next(row for row in table.rows if row[0] == "0 kg, targets as they are")
    assert [cell.mean for cell in raw[1:]] == pytest.approx([2.0, 2.0, 2.0])  # cm


def test_a_row_of_table_2_above_half_of_nominal_is_not_converged():
    good = training("payload out", 0.4, "table2")
    bad = training("history 2", 0.6, "table2")
    rows = table_2(make_results(good, bad)).rows
    assert [row[-2] for row in rows] == ["", "not converged"]
    assert rows[0][2].mean == pytest.approx(40.0)  # mrad: 0.4 · 0.2 rad·s in 2 s


def test_the_row_of_a_faster_rate_has_the_recordings_of_that_rate():
    run = training("100 Hz", 0.4, "table2")
    run["alignment"]["q_dis"] = [[0.06, 0.06], [0.02, 0.02], [0.04, 0.04]]
    results = make_results(run)
    results.baselines["nominal_fastest"] = {"alignment": {"q_dis": [[0.2, 0.2]] * 3}}
    fastest = SimpleNamespace(durations=[3.0, 1.0, 2.0], payloads=[0.0, 0.0, 0.0])
    results.study.rates = (50.0, 100.0)
    results.study.recorded = {100.0: fastest}.get
    ((name, _, empty_handed, loaded, *_),) = table_2(results).rows
    assert name == "100 Hz"
    assert empty_handed.mean == pytest.approx(20.0)
    assert loaded is None
