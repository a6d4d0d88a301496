"""The drawing on the page of the architecture is that of the code."""

import architecture_map as drawing


def test_the_drawing_on_the_page_is_that_of_the_code():
    page = drawing.PAGE.read_text(encoding="utf-8")
    drawn = page.partition(drawing.BEGIN)[2].partition(drawing.END)[0]
    assert drawn == drawing.draw(drawing.read_imports())


def test_an_import_that_follows_from_two_others_is_not_drawn():
    imports = {"top": {"middle", "low"}, "middle": {"low"}, "low": set()}
    assert drawing.without_shortcuts(imports) == {
        "top": {"middle"},
        "middle": {"low"},
        "low": set(),
    }
