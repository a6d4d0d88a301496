"""Words of others in figures."""

import warnings
from xml.etree import ElementTree

from gaponet.report.figures.style import figure, legend, save, styled

HOSTILE = "a \x1b[31m\x00 $b_{ <script>"


@styled
def drawn():
    fig = figure(4, 3)
    ax = fig.subplots()
    ax.plot([0, 1], label=HOSTILE)
    ax.set_xticks([0, 1], [HOSTILE, "b"])
    ax.set_title(HOSTILE)
    legend(fig)
    return fig


def test_controls_in_names_are_escapes_and_the_svg_is_well_formed(tmp_path):
    fig = drawn()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        svg, png = save(fig, tmp_path / "figure")
    ElementTree.parse(svg)
    assert png.read_bytes()[:4] == b"\x89PNG"
    shown = "a \\x1b[31m\\x00 $b_{ <script>"
    assert fig.axes[0].get_title(loc="left") == shown
    assert fig.axes[0].get_xticklabels()[0].get_text() == shown
    assert fig.legends[0].get_texts()[0].get_text() == shown


def test_a_name_of_a_thousand_letters_leaves_room_for_the_data(tmp_path):
    @styled
    def draw():
        fig = figure(4, 3)
        ax = fig.subplots()
        ax.barh([0, 1], [1, 2], label="unit " * 200)
        ax.set_yticks([0, 1], ["motion " * 200, "b"])
        legend(fig)
        return fig

    fig = draw()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        save(fig, tmp_path / "figure")
    assert fig.axes[0].get_window_extent().width > 0.2 * fig.bbox.width
