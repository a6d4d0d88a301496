"""What gaponet data export writes comes back: nothing is lost."""

from dataclasses import replace

import numpy as np
import pytest
from logs import arm_sequence, late, wave, write_so101

from gaponet.cli.main import main
from gaponet.data.formats import detect
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.data.store import Dataset
from gaponet.data.writers import export

SAID = (
    "motion",
    "unit_id",
    "payload_mass",
    "payload_side",
    "level",
    "repetition",
    "virtual",
    "kp",
    "kd",
)


@pytest.fixture
def dataset(arm, tmp_path):
    """Two motions, one with a payload and other gains, of a virtual robot, at a rate that is no
    whole number.
    """
    data = Dataset.create(tmp_path / "data", arm)
    for i, gains in enumerate(((20.0, 20.0), (12.5, 0.1))):
        ctrl = wave(50, 2, hertz=0.4 + 0.13 * i) + 0.1 * i
        more = (
            {"tau": 2 * ctrl, "qacc": 3 * ctrl, "tau_eq": ctrl, "temperature": 30 + ctrl}
            if i
            else {"tau": ctrl}
        )
        sequence = arm_sequence(
            arm, ctrl, late(ctrl, 2), f"wave {i}", 0.1 * i, unit=f"u{i}", **more
        )
        meta = {
            "kp": gains,
            "kd": (0.0, 1 / 3),
            "virtual": bool(i),
            "level": "joint",
            "repetition": 4,
        }
        data.append(
            replace(sequence, dt=1 / 30 if i else 0.02006, meta=replace(sequence.meta, **meta))
        )
    return data


def test_what_is_written_is_read_back_without_a_word(dataset, arm, tmp_path):
    export(dataset, tmp_path / "out")
    assert detect(tmp_path / "out") == "lerobot"
    import_logs(tmp_path / "out", arm, tmp_path / "again", ImportRequest())
    again = {e.meta.motion: e for e in Dataset(tmp_path / "again").entries}
    for entry in dataset.entries:
        back = again[entry.meta.motion]
        assert back.hash == entry.hash
        assert back.dt == pytest.approx(entry.dt, abs=5e-8)
        assert set(back.channels) == set(entry.channels)
        assert {n: getattr(back.meta, n) for n in SAID} == {n: getattr(entry.meta, n) for n in SAID}
        one, other = dataset.read(entry), Dataset(tmp_path / "again").read(back)
        for name in back.channels:
            assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_rates_that_look_the_same_go_into_folders_of_their_own(arm, tmp_path):
    data = Dataset.create(tmp_path / "data", arm)
    periods = (0.0200031, 0.02000310001, 0.02000310002)
    for i, dt in enumerate(periods):
        ctrl = wave(50, 2, hertz=0.4 + 0.13 * i)
        data.append(replace(arm_sequence(arm, ctrl, late(ctrl, 2), f"m{i}"), dt=dt))
    written = export(data, tmp_path / "out")
    assert len({part.path for part in written}) == 3
    import_logs(tmp_path / "out", arm, tmp_path / "again", ImportRequest())
    assert {e.meta.motion for e in Dataset(tmp_path / "again").entries} == {"m0", "m1", "m2"}


def test_a_gripper_goes_out_and_comes_back_as_a_share_of_its_range(so101, tmp_path):
    write_so101(tmp_path / "logs" / "wave")
    import_logs(
        tmp_path / "logs", so101, tmp_path / "data", ImportRequest(unit_id="a", payload_mass=0.0)
    )
    export(Dataset(tmp_path / "data"), tmp_path / "out")
    import_logs(tmp_path / "out", so101, tmp_path / "again", ImportRequest())
    one, other = (Dataset(tmp_path / d) for d in ("data", "again"))
    assert one.entries[0].hash == other.entries[0].hash


def test_the_command_says_how_to_come_back_and_overwrites_nothing(
    dataset, tmp_path, capsys, monkeypatch
):
    words = ["data", "export", str(dataset.path), "--out", str(tmp_path / "set")]
    assert main(words) == 0
    assert f"gaponetimport{tmp_path / 'set'}" in "".join(capsys.readouterr().out.split())
    assert main(words) == 2
    assert "exists and is not an empty folder" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    assert main([*words[:-1], "."]) == 2
    assert "name a new folder" in capsys.readouterr().err
