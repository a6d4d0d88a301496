"""Provenance of numbers: recordings of VIRTUAL robots are called virtual wherever their numbers appear."""

from __future__ import annotations

from gaponet.data.store import Dataset, Entry


def robot_label(entries: list[Entry]) -> str:
    """Return the robot's name; "VIRTUAL h1_2" or "partly VIRTUAL h1_2" where recordings are virtual."""
    virtual = sum(e.meta.virtual for e in entries)
    kind = "" if not virtual else "VIRTUAL " if virtual == len(entries) else "partly VIRTUAL "
    return kind + entries[0].meta.robot


def describe_provenance(dataset: Dataset) -> str:
    """Return a sentence that says on which robot the recordings were made."""
    virtual = [e.meta.virtual for e in dataset.entries]
    if not any(virtual):
        return f"Recordings of a real {dataset.robot_name}."
    some = "" if all(virtual) else "Partly "
    fleets = sorted({e.meta.source for e in dataset.entries if e.meta.virtual and "fleet" in e.meta.source})
    names = f" ({', '.join(fleets)})" if fleets else ""
    return f"{some}VIRTUAL {dataset.robot_name}{names}: these numbers say nothing about real hardware."
