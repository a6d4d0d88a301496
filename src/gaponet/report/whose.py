"""Whose recordings numbers come from: VIRTUAL robots are called virtual wherever numbers appear."""

from __future__ import annotations

from gaponet.data.store import Dataset, Entry


def who(entries: list[Entry]) -> str:
    """ "VIRTUAL h1_2" where any of it was not recorded on hardware."""
    virtual = sum(e.meta.virtual for e in entries)
    kind = "" if not virtual else "VIRTUAL " if virtual == len(entries) else "partly VIRTUAL "
    return kind + entries[0].meta.robot


def label(dataset: Dataset) -> str:
    """Whose recordings these are."""
    virtual = [e.meta.virtual for e in dataset.entries]
    if not any(virtual):
        return f"Recordings of a real {dataset.robot_name}."
    some = "" if all(virtual) else "Partly "
    fleets = sorted({e.meta.source for e in dataset.entries if e.meta.virtual and "fleet" in e.meta.source})
    named = f" ({', '.join(fleets)})" if fleets else ""
    return f"{some}VIRTUAL {dataset.robot_name}{named}: these numbers say nothing about real hardware."
