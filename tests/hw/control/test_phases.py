"""The controller's state machine: every event in every phase, and the same table in
docs/reference/controller.md.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path

import pytest

from gaponet.hw.control.phases import (
    COMMANDING,
    ENDED,
    TRANSITION_TABLE,
    TRANSITIONS,
    Action,
    Phase,
    PhaseMachine,
    Trigger,
)

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "controller.md"
WAITING = (Phase.CONNECT, Phase.IDLE)
SENDING = {Action.BLEND_IN, Action.PLAY, Action.GO_BACK, Action.RELEASE}


def test_every_event_is_defined_once_in_every_phase_and_leads_forward():
    named = [pair for row in TRANSITIONS if row[1] != tuple(Trigger) for pair in product(*row[:2])]
    assert len(named) == len(set(named))
    assert TRANSITION_TABLE.keys() == set(product(Phase, Trigger))
    order = list(Phase)
    for (phase, _), (following, action) in TRANSITION_TABLE.items():
        if action in (Action.IGNORE, Action.RAISE):
            assert following is phase
        else:
            assert order.index(following) > order.index(phase), (
                "no way leads back, and each one ends"
            )
            assert (action in SENDING, action is Action.DAMP) == (
                following in COMMANDING,
                following is Phase.DAMP,
            )


@pytest.mark.parametrize("missing", [Trigger.CONSENT, Trigger.READY])
def test_nothing_moves_without_consent_and_a_robot_that_is_ready(missing):
    reached = {Phase.CONNECT}
    # Phases are in the order in which they can be reached.
    for phase, trigger in product(Phase, Trigger):
        if phase in reached and trigger is not missing:
            reached.add(TRANSITION_TABLE[phase, trigger][0])
    assert reached <= {*WAITING, Phase.STOPPED}


@pytest.mark.parametrize("phase", Phase)
@pytest.mark.parametrize("fault", [t for t in Trigger if "FAULT" in t.name])
def test_a_fault_in_any_phase_ends_damped_or_in_silence_and_sends_no_position(phase, fault):
    following, action = TRANSITION_TABLE[phase, fault]
    if phase in ENDED:
        assert action is Action.IGNORE, "it goes on damping, or has ended"
    elif phase in WAITING or fault in (Trigger.FAULT_BEFORE_COMMAND, Trigger.FAULT_AFTER_WATCHDOG):
        assert (following, action) == (Phase.STOPPED, Action.SEND_NOTHING), (
            "never commanded, or damped already"
        )
    else:
        assert (following, action) == (Phase.DAMP, Action.DAMP)


def test_an_event_that_cannot_happen_in_a_phase_is_an_error_and_changes_nothing():
    impossible = [
        trigger
        for trigger in Trigger
        if TRANSITION_TABLE[Phase.CONNECT, trigger][1] is Action.RAISE
    ]
    machine = PhaseMachine()
    for trigger in impossible:
        with pytest.raises(AssertionError, match=trigger.name):
            machine.fire(trigger, period=3)
    assert impossible
    assert machine.phase is Phase.CONNECT


def test_the_page_has_the_same_table():
    def row(*cells: str) -> str:
        return f"| {' | '.join(cells)} |"

    page = PAGE.read_text(encoding="utf-8").splitlines()
    for phases, triggers, following, action in TRANSITIONS:
        events = (
            "any other"
            if triggers == tuple(Trigger)
            else ", ".join(t.name.lower() for t in triggers)
        )
        assert row(", ".join(phases), events, following or "the same", action.value) in page
    for trigger in Trigger:
        assert row(trigger.name.lower(), trigger.value) in page
    states = page[page.index("## State machine") : page.index("## Tests")]
    assert sum(line.startswith("| ") for line in states) == len(TRANSITIONS) + len(Trigger) + 2
