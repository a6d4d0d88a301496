import pytest

from gaponet.text import measured


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [(7.43e-5, 1.3, "0.0 ± 1.3"), (320.4, 168.0, "320 ± 170"), (19.63, 0.912, "19.63 ± 0.91"),
     (-0.01234, 0.00071, "-0.01234 ± 0.00071"), (1234.0, 5678.0, "1200 ± 5700"), (2.0, float("nan"), "2.000 ± nan")],
)  # fmt: skip
def test_a_measured_number_has_the_digits_that_its_error_allows(value, error, text):
    assert measured(value, error) == text
