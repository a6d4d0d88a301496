"""A small part of a dataset: linked, every group represented, made again without harm."""

from gaponet.experiment.slice import rehearsal, take


def test_few_motions_but_every_kind_of_group(make_study, tmp_path):
    data = make_study(rates=(50, 100), payloads=(0.0, 0.1, 0.2, 0.3), units=("a", "b")).data
    entries = rehearsal(data)
    assert {e.meta.payload_mass for e in entries} == {0.0, 0.2, 0.3}  # lightest, middle, heaviest
    assert {round(1 / e.dt) for e in entries} == {50, 100}
    part = take(data, entries, tmp_path / "part")
    assert [e.hash for e in part.entries] == [e.hash for e in entries]
    assert (part.sequences()[0].qpos == data.read(entries[0]).qpos).all()
    again = take(data, entries, tmp_path / "part")
    assert len(again) == len(entries)
