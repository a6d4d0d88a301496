"""The ablation's table: which cells it needs, and what it says about numbers worked by hand."""

import pytest

from gaponet_lab.study.ablation import DEFAULT, Ablation, rows
from gaponet_lab.study.options import Options


def found(*mpjae, **more):
    same = {"parameters": 10, "seconds": 60.0} | more
    return [{"seed": i, "known": {"mpjae": v, "q_dis": v}} | same for i, v in enumerate(mpjae)]


def test_the_default_is_one_model_in_every_row_that_it_stands_in(make_study):
    study = make_study()
    lines, missing = rows(study)
    assert missing == ["Control rates were not compared: the dataset holds 50 Hz alone."]
    factors = {r.factor for r in lines}
    assert {r.factor for r in lines if r.word == DEFAULT} == factors
    assert len([r for r in lines if r.word == DEFAULT]) == len(factors)
    words = {r.word for r in lines}
    assert len(words) == len(lines) - len(factors) + 1
    configs = {repr(study.variant(w).config) for w in words}
    assert len(configs) == len(words)


def test_the_paper_s_rows_are_all_there(make_study):
    words = {r.word for r in rows(make_study(rates=(50, 100)))[0]}
    held = [f"delta_hold={k}" for k in (3, 5)]
    changes = ["payload_input=off", "rates=100", "rates=100:history=8", "history=2", "history=6", "history=8"]
    for change in [*changes, *held, "sensor_target=absolute"]:
        assert f"{DEFAULT}:{change}" in words


def test_with_two_rates_all_but_the_rows_about_them_are_trained_on_the_slower(make_study):
    study = make_study(rates=(50, 100), payloads=(0.0,), units=("a",))
    lines, missing = rows(study)
    assert study.config.rates == (50.0,)
    assert {study.variant(r.word).config.rates for r in lines if r.factor != "control rate"} == {(50.0,)}
    settings = [r.setting for r in lines if r.factor == "control rate"]
    assert settings == ["50 Hz", "100 Hz, equal H", "100 Hz, equal window"]
    assert missing == ["Payload input was not compared: the dataset holds one payload."]


NOMINAL = {"nominal": {"known": {"mpjae": 0.01}}}


def test_the_table_holds_spread_ratio_and_the_paper_s_range(make_study, make_found):
    data = {DEFAULT: found(0.001, 0.003), "gaponet:payload_input=off": found(0.0041, 0.0039)}
    made = Ablation().result(make_study(), make_found(data, NOMINAL))
    texts = {row[0]: row[1:] for row in made.tables[0].texts()}
    assert texts["payload input: in (default)"] == [
        "2.00 ± 1.41", "0.20 ± 0.14", "", "2.00 ± 1.41", "10", "1.00"
    ]  # fmt: skip
    assert texts["payload input: out"][:3] == ["4.00 ± 0.14", "0.40 ± 0.01", "2.70 ± 1.98"]  # 4.1 / 1, 3.9 / 3
    assert texts["sensors: off"] == [""] * 6  # nothing came of it, and it is not invented
    assert made.sentences[-1] == "Control rates were not compared: the dataset holds 50 Hz alone."


@pytest.mark.parametrize(
    ("with_it", "without", "verdict"),
    [((0.0030, 0.0031), (0.0040, 0.0041), "finds 25 % less"), ((0.0040, 0.0041), (0.0030, 0.0031), "finds 33 % more"),
     ((0.003, 0.005), (0.003, 0.0051), "finds no difference")],
)  # fmt: skip
def test_where_the_paper_is_contradicted_the_sentence_says_so(make_study, make_found, with_it, without, verdict):
    data = {DEFAULT: found(*with_it), "gaponet:payload_input=off": found(*without)}
    said = Ablation().result(make_study(), make_found(data, NOMINAL)).sentences
    (sentence,) = (s for s in said if "paper" in s)
    assert f"this run {verdict}" in sentence
    assert "the paper has 23 to 42 % more error with 'in' than with 'out'" in sentence  # 16/13, 17/12


def test_the_paper_s_rows_stand_beside_ours_payload_by_payload(make_study, make_found):
    data = {DEFAULT: found(0.002), "gaponet:payload_input=off": found(0.003)}
    for word, mass in ((DEFAULT, 0.004), ("gaponet:payload_input=off", 0.005)):
        data[word][0]["known"] |= {"by_payload": {"3": {"mpjae": mass}}, "large_0.05": 0.01}
    table = Ablation().result(make_study(payloads=(0.0, 3.0)), make_found(data, NOMINAL)).tables[1]
    by = {row[0]: dict(zip(table.columns, row, strict=True)) for row in table.texts()}
    told, silent = by["payload input: in"], by["payload input: out"]
    assert int(told["Obs Dim"]) == int(silent["Obs Dim"]) + 1
    assert (told["paper: Obs Dim"], silent["paper: Obs Dim"]) == ("141", "140")
    assert (told["3 kg, mrad"], silent["3 kg, mrad"]) == ("4.00", "5.00")
    assert (told["3 kg, mrad, paper"], silent["3 kg, mrad, paper"]) == ("19", "15")
    assert told["large gaps, %"] == "1.00"
    assert not any(name.startswith("basis") for name in by)  # of which the paper has no number


def test_one_seed_is_called_one_seed(make_study, make_found):
    data = {DEFAULT: found(0.002), "gaponet:sensors=off": found(0.003)}
    sentences = Ablation().result(make_study(), make_found(data, NOMINAL)).sentences
    assert "sensors: off 50 % more than the default (one seed)." in sentences


def test_what_a_seed_does_to_both_is_no_difference_and_hides_none(make_study, make_found):
    data = {DEFAULT: found(0.002, 0.003, 0.004), "gaponet:sensors=off": found(0.0021, 0.0031, 0.0042),
            "gaponet:payload_input=off": found(0.0022, 0.0028, 0.004)}  # fmt: skip
    sentences = Ablation().result(make_study(), make_found(data, NOMINAL)).sentences
    assert "sensors: off 4 % more than the default (seeds ± 1 %)." in sentences
    assert "payload input: out no different from the default (+1 %, seeds ± 8 %)." in sentences


def test_a_rehearsal_lies_beside_the_real_thing_and_is_called_one(make_study, make_found, tmp_path):
    study = make_study(quick=True)
    assert study.out == tmp_path / "out" / "rehearsal"
    assert study.seeds == 1
    assert len(study.data) < 8 * 3 * 2 + 1
    made = Ablation().result(study, make_found({DEFAULT: found(0.002)}, NOMINAL))
    assert "REHEARSAL" in made.title
    assert "mean nothing" in made.facts["rehearsal"]
    assert Options().quick is False
