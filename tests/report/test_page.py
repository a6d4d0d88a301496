"""A page is HTML of ours and text of others, and the text stays text."""

from matplotlib.figure import Figure

from gaponet.report.figures.style import styled
from gaponet.report.page import element, facts_table, figure, page, picture, table

HOSTILE = "<script>alert('x')</script> & \"q\" \x1b[1m\n$a_b$"
SHOWN = "&lt;script&gt;alert(&#39;x&#39;)&lt;/script&gt; &amp; &#34;q&#34; \\x1b[1m\\n$a_b$"


def test_text_is_escaped_once_wherever_it_stands():
    body = element("p", HOSTILE, element("b", HOSTILE)) + facts_table([[HOSTILE, "1"]]) + table([HOSTILE], [[HOSTILE]])
    whole = page(HOSTILE, body)
    assert whole.count(SHOWN) == 6
    assert "<script" not in whole
    assert "&amp;lt;" not in whole


def test_text_given_as_a_body_is_text():
    assert "<script" not in page("t", HOSTILE)


def test_a_name_in_a_figure_is_letters_and_no_formula():
    @styled
    def draw():
        fig = Figure()
        fig.subplots().set_title("$broken_{ <script>alert(1)</script>")
        return fig

    drawn = figure(draw(), HOSTILE)
    assert "<script" not in drawn
    assert SHOWN in drawn


def test_a_script_in_somebodys_svg_does_not_reach_the_page():
    assert "script" not in picture(b"<svg><script>alert(1)</script></svg>", "image/svg+xml")
