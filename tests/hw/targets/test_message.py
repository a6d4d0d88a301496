"""Names of those who send live targets, as the events of a run show them."""

import pytest

from gaponet.hw.targets.message import sender_name


@pytest.mark.parametrize(
    ("sender", "name"), [(b"\x00\xff", "00ff"), (255, "ff"), ("a pipe", "a pipe")]
)
def test_a_sender_has_a_name_that_can_be_printed(sender, name):
    assert sender_name(sender) == name
