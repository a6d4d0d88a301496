"""Templates of pages: texts of others stay text."""

from gaponet.report.figures.style import figure, styled
from gaponet.report.page import inline_image, page_figure, render

HOSTILE = "<script>alert('x')</script> & \"q\" \x1b[1m\n$a_b$"
SHOWN = "&lt;script&gt;alert(&#39;x&#39;)&lt;/script&gt; &amp; &#34;q&#34; \\x1b[1m\\n$a_b$"


def test_text_is_escaped_once_wherever_it_stands():
    page = render(
        "paper.html.j2",
        title=HOSTILE,
        virtual=False,
        provenance=HOSTILE,
        failures=[HOSTILE],
        diagram="",
        sections=[],
        facts=[[HOSTILE] * 2],
    )
    assert page.count(SHOWN) == 2 + 1 + 1 + 2
    assert "<script" not in page
    assert "&amp;lt;" not in page


def test_a_name_in_a_figure_is_letters_and_no_formula():
    @styled
    def draw():
        fig = figure(3, 3)
        fig.subplots().set_title("$broken_{ <script>alert(1)</script>")
        return fig

    drawn = page_figure(draw(), HOSTILE)
    assert "<script" not in drawn.image
    assert drawn.css == "plot"


def test_a_script_in_somebodys_svg_does_not_reach_the_page():
    assert "script" not in inline_image(b"<svg><script>alert(1)</script></svg>", "image/svg+xml")
