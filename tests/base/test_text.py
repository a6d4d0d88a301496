import pytest

from gaponet.base.errors import GAPONetError
from gaponet.base.result_table import ResultTable
from gaponet.base.text import escape_markdown, format_uncertainty


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (7.43e-5, 1.3, "0.0 ± 1.3"),
        (320.4, 168.0, "320 ± 170"),
        (19.63, 0.912, "19.63 ± 0.91"),
        (-0.01234, 0.00071, "-0.01234 ± 0.00071"),
        (1234.0, 5678.0, "1200 ± 5700"),
        (2.0, float("nan"), "2.000 ± nan"),
        (5.0, 3e4, "5 ± ?"),
        (-0.2, 26.0, "0 ± 26"),
    ],
)
def test_the_standard_error_determines_the_digits(value, error, text):
    assert format_uncertainty(value, error) == text


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("s3://KEY:se/cret@bucket/x: no", "s3://bucket/x: no"),
        ("'ftp://u:secret@h/x' and gs://me@b/y", "'ftp://h/x' and gs://b/y"),
        ("s3:/KEY:se/c@ret@bucket/x", "s3://bucket/x"),
        (
            "file:///logs@home/a@b, s3://bucket/a@b, s3://bucket/x",
            "file:///logs@home/a@b, s3://bucket/a@b, s3://bucket/x",
        ),
    ],
)
def test_errors_do_not_show_credentials_of_addresses(text, shown):
    assert str(GAPONetError(text)) == shown


def test_markdown_markup_in_a_name_is_escaped():
    assert escape_markdown("![x](https:evil.example)") == r"!\[x\](https:evil.example)"


def test_in_a_markdown_table_numbers_are_on_the_right_and_words_on_the_left():
    rows = (("so101", "new motions", 3.1), ("h1_2", "2 kg left out", None))
    table = ResultTable("t", ("set", "question", "mrad"), rows)
    assert table.markdown().splitlines()[1] == "| --- | --- | ---: |"
