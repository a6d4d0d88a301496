"""The part of a dataset of a quick run: every group represented, made again without harm."""

from gaponet.experiments.study import quick_dataset


def test_few_motions_and_every_kind_of_group(make_study, arm, tmp_path):
    data = make_study(rates=(50, 100), payloads=(0.0, 0.1, 0.2, 0.3), units=("a",)).data
    part = quick_dataset(data, arm, tmp_path / "part")
    assert {e.meta.payload_mass for e in part.entries} == {
        0.0,
        0.2,
        0.3,
    }  # lightest, middle, heaviest
    assert {round(1 / e.dt) for e in part.entries} == {50, 100}
    originals = {
        (e.meta.motion, e.meta.payload_mass, e.meta.unit_id, e.dt): e for e in data.entries
    }
    for entry, sequence in zip(part.entries, part.sequences(), strict=True):
        whole = data.read(
            originals[entry.meta.motion, entry.meta.payload_mass, entry.meta.unit_id, entry.dt]
        )
        assert entry.rows == min(len(whole), round(2.0 / entry.dt))
        assert (sequence.qpos == whole.qpos[: entry.rows]).all()
    assert len(quick_dataset(data, arm, tmp_path / "part")) == len(part)
