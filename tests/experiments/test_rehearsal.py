"""A small part of a dataset: every group represented, made again without harm."""

from gaponet.experiments.rehearsal import rehearsal, take


def test_few_motions_but_every_kind_of_group(make_study, arm, tmp_path):
    data = make_study(rates=(50, 100), payloads=(0.0, 0.1, 0.2, 0.3), units=("a", "b")).data
    entries = rehearsal(data)
    assert {e.meta.payload_mass for e in entries} == {0.0, 0.2, 0.3}  # lightest, middle, heaviest
    assert {round(1 / e.dt) for e in entries} == {50, 100}
    part = take(data, arm, entries, tmp_path / "part", seconds=0.5)
    assert [e.meta for e in part.entries] == [e.meta for e in entries]
    assert {e.rows for e in part.entries} == {25, 40}  # 0.5 s at 50 Hz; at 100 Hz the recordings end before
    assert (part.sequences()[0].qpos == data.read(entries[0]).qpos[:25]).all()
    assert len(take(data, arm, entries, tmp_path / "part", seconds=0.5)) == len(entries)
