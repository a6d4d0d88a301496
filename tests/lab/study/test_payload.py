"""Payloads left out: which, and what is said about numbers worked by hand."""

import pytest

from gaponet.errors import UsageError
from gaponet_lab.study.payload import ALL, BLIND, Payload


def found(*mpjae, payloads=("0", "0.1", "0.2")):
    by = lambda v: {p: {"mpjae": v * (1 + i)} for i, p in enumerate(payloads)}  # noqa: E731
    return [{"known": {"by_payload": by(v)}, "seconds": 60.0} for v in mpjae]


def test_the_two_heaviest_are_left_out_by_default_and_each_is_asked_blind_too(make_study):
    study = make_study(seeds=1)
    asked = Payload().left_out(study.data)
    assert [(q.name, q.payload) for q in asked] == [("between", 0.1), ("beyond", 0.2)]
    made = Payload().cells(study)
    assert {c.variant.config.holdout_payloads for c in made} == {(), (0.1,), (0.2,)}
    assert sum(not c.variant.config.model.payload_input for c in made) == 3


def test_a_payload_that_cannot_be_between_or_beyond_is_refused(make_study):
    data = make_study().data
    with pytest.raises(UsageError, match=r"--between 0\.2: lies not between payloads"):
        Payload(between=0.2).left_out(data)
    with pytest.raises(UsageError, match=r"--beyond 0\.1: is not the lightest or heaviest"):
        Payload(beyond=0.1).left_out(data)


def test_two_payloads_are_too_few(make_study):
    with pytest.raises(UsageError, match="needs 3"):
        Payload().left_out(make_study(payloads=(0.0, 0.2)).data)


def test_errors_at_the_payload_left_out_are_what_is_said(make_study, make_found):
    study = make_study()
    asked = Payload().left_out(study.data)
    told, blind = asked[0].words
    base = {"nominal": found(0.010)[0], "delay_offset": found(0.008)[0]}
    data = {
        ALL: found(0.002, 0.0021),
        told: found(0.003, 0.0031),
        blind: found(0.006, 0.0061),
        ALL + BLIND: found(0.004),
    }
    made = Payload().result(study, make_found(data, base))
    # At 0.1 kg everything is doubled: nominal 20 mrad, told 6.1, with it in training 4.1, not told 12.1.
    assert made.sentences == (
        "At 0.1 kg, between the payloads trained on, 0.30 of the nominal 20.00 mrad is left; with it in training 4.10 "
        "mrad, 33 % less than that; mass not told 12.10 mrad, 98 % more than when told.",
    )
    names = [row[0] for row in made.tables[0].rows]
    assert names[:2] == ["nominal simulator", "delay + offset"]
    assert "GAPONet trained without 0.1 kg, mass not told" in names
    left, right = made.figures["payload"].axes
    assert "0.1 kg left out, between the others" in left.get_title(loc="left")
    assert "VIRTUAL" in right.get_title(loc="left")
