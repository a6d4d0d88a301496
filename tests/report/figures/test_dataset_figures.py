"""The pictures of a dataset: what they show is what the data are, and they say what they cannot
show.
"""

import numpy as np
import pytest
from arm import recordings
from logs import arm_sequence, late, wave

from gaponet.base.errors import DatasetError
from gaponet.data.store import Dataset
from gaponet.evaluation.candidate import robot_label
from gaponet.evaluation.evaluate import evenly_spaced
from gaponet.report.figures import dataset_figures as draw
from gaponet.report.figures.dataset_figures import largest_torque_change, swing, write_figures
from gaponet.report.figures.style import save


@pytest.fixture
def dataset(arm, tmp_path):
    """Three motions of one unit with two payloads, torque and temperature; the last has the
    liveliest torques.
    """
    data = Dataset.create(tmp_path / "data", arm)
    for i in range(3):
        for payload in (0.0, 0.2):
            ctrl = wave(60, 2, hertz=0.4 + 0.1 * i)
            tau = (1 + i + payload) * ctrl
            warm = 30 + payload * np.arange(60)[:, None] * np.ones(2)
            data.append(
                arm_sequence(arm, ctrl, late(ctrl, 2), f"m{i}", payload, tau=tau, temperature=warm)
            )
    return data


def test_every_picture_is_drawn_as_svg_and_png(dataset, arm, tmp_path):
    told = []
    written, left_out = write_figures(
        dataset, arm, tmp_path / "out", lambda *what: told.append(what)
    )
    names = ["composition", "joint_ranges", "torque_temperature"]
    assert sorted(p.name for p in written) == [f"{n}.{s}" for n in names for s in ("png", "svg")]
    assert left_out == {}
    assert told[-1][0] == told[-1][1] == len(names)
    assert all(p.stat().st_size > 2000 for p in written)


def test_the_same_data_give_the_same_svg(tmp_path):
    values = {"elbow": np.linspace(-1, 1, 500)}
    for name in ("one", "two"):
        save(draw.draw_joint_ranges(values, {"elbow": (-1.5, 1.5)}, "t"), tmp_path / name)
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()


def test_a_figure_without_data_is_skipped_with_a_reason(arm, tmp_path):
    data = Dataset.create(tmp_path / "data", arm)
    still = np.full((60, 2), 0.1)
    data.append(arm_sequence(arm, still, still + 0.01))
    written, left_out = write_figures(data, arm, tmp_path / "out")
    assert left_out == {
        "joint_ranges": "no operated joint is commanded to move",
        "torque_temperature": "no torque was recorded",
    }
    assert len(written) == 2


def test_the_motion_whose_torques_change_most_is_shown(dataset, arm):
    assert {e.meta.motion for e in largest_torque_change(dataset, arm)} == {"m2"}


def test_spikes_do_not_count_as_swing():
    values = np.zeros((100, 1))
    values[50] = 1000.0
    assert swing(values) == [0.0]
    assert swing(np.linspace(0, 1, 101)[:, None]) == pytest.approx([0.9])


def test_items_are_chosen_evenly():
    assert evenly_spaced([1, 2, 3], 5) == [1, 2, 3]
    assert evenly_spaced(list(range(101)), 3) == [0, 50, 100]


def test_the_title_names_virtual_robots(dataset, arm):
    real = dataset.entries
    virtual = Dataset.create(dataset.path.parent / "virtual", arm)
    virtual.append(recordings(arm, 1, rows=20)[0])
    assert robot_label(real) == "arm"
    assert robot_label(virtual.entries) == "VIRTUAL arm"
    assert robot_label([*real, *virtual.entries]) == "partly VIRTUAL arm"
    fig = draw.composition(virtual, arm)
    assert fig.legends[0].get_title().get_text().startswith("VIRTUAL arm")


def test_bars_are_as_high_as_the_hours(dataset, arm):
    fig = draw.composition(dataset, arm)
    payload, unit, rate = fig.axes
    assert [b.get_height() for b in payload.patches] == pytest.approx([180 * 0.02 / 3600] * 2)
    assert [b.get_height() for b in unit.patches] == pytest.approx([360 * 0.02 / 3600])
    assert [t.get_text() for t in rate.get_xticklabels()] == ["50"]


def test_warming_is_counted_from_the_start(dataset):
    takes = {e.meta.payload_mass: dataset.read(e) for e in dataset.entries[:2]}
    fig = draw.draw_torque_temperature(takes, ["elbow"], "t")
    light, heavy = (line.get_ydata() for line in fig.axes[2].lines)
    assert light.max() == 0
    assert (heavy[0], heavy[-1]) == (0, pytest.approx(0.2 * 59, abs=1e-4))


def test_a_sequence_without_temperature_has_no_such_row(arm):
    ctrl = wave(60, 2)
    fig = draw.draw_torque_temperature(
        {0.0: arm_sequence(arm, ctrl, ctrl, tau=ctrl)}, ["elbow", "shoulder"], "t"
    )
    assert [ax.get_ylabel() for ax in fig.axes[::2]] == ["position, rad", "torque, N·m"]


def test_a_joint_without_limits_gets_no_grey_range():
    values = np.linspace(-1, 1, 500)
    limits = {"left_elbow": (-1.5, 1.5), "spin": (-np.inf, np.inf)}
    fig = draw.draw_joint_ranges(dict.fromkeys(limits, values), limits, "t")
    ax = fig.axes[0]
    assert len(ax.patches) == 1
    assert ax.patches[0].get_width() == pytest.approx(3.0)
    assert [t.get_text() for t in ax.get_yticklabels()] == ["left elbow", "spin"]


def test_an_empty_dataset_has_no_pictures(arm, tmp_path):
    with pytest.raises(DatasetError, match="sequences"):
        write_figures(Dataset.create(tmp_path / "none", arm), arm, tmp_path / "out")
