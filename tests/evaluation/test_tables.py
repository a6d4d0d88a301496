"""How errors are written."""

from gaponet.evaluation.tables import mrad
from gaponet.sim.metrics import standard_error


def test_errors_are_in_milliradian_and_missing_ones_are_a_dash():
    assert [mrad(x) for x in (0.01234, None, standard_error([0.01]))] == ["12.34", "–", "–"]
