"""The doctor finds no error in public recordings of real robots, and contradicts itself nowhere."""

import shutil

import pytest
from conftest import SHARED
from real_robots.cards import prepare, read_cards

from gaponet import api

CARDS = {card.name: card for card in read_cards().set}


def test_no_recording_is_called_early_where_its_measured_lags_are_those_of_the_others(
    sage_so101, tmp_path
):
    for folder in sorted(f.parent for f in sage_so101.rglob("control.csv"))[:12]:
        shutil.copytree(folder, tmp_path / "logs" / folder.name)
    data = tmp_path / "data"
    api.import_logs(tmp_path / "logs", robot="so101", out=data, unit_id="u", payload_mass=0.0)
    diagnosis = api.doctor(data)
    warned = [f for f in diagnosis.findings if f.check == "lag" and f.level == "warning"]
    assert warned == []


@pytest.mark.slow
@pytest.mark.parametrize("name", CARDS)
def test_no_real_set_has_an_error(tmp_path, name):
    if not (SHARED / CARDS[name].folder).is_dir():
        pytest.skip(f"no {CARDS[name].folder} in {SHARED}")
    dataset, robot, _ = prepare(CARDS[name], SHARED, tmp_path)
    diagnosis = api.doctor(dataset, robot=robot)
    assert [f for f in diagnosis.findings if f.level == "error"] == []
