"""Every method has one colour."""

from gaponet.report.evaluate import ORDER
from gaponet.report.figures.colours import colour, palette, shade


def test_every_method_that_is_measured_has_a_colour_of_its_own():
    assert len({colour(m) for m in ORDER}) == len(ORDER)


def test_a_method_has_the_colour_that_it_has_everywhere_and_its_variants_shades_of_it():
    found = palette(["mlp", "mlp:history=8", "new", "identified+mlp"])
    assert found["mlp"] == colour("mlp")
    assert len(set(found.values())) == 4
    light = {name: sum(int(c[i : i + 2], 16) for i in (1, 3, 5)) for name, c in found.items()}
    assert light["identified+mlp"] < light["mlp"] < light["mlp:history=8"]


def test_shades_are_nearer_to_white_or_to_black():
    assert shade("#804000", 0.5) == "#c0a080"
    assert shade("#804000", -0.5) == "#402000"
