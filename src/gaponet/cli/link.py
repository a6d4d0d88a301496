"""How a robot's states arrive, for gaponet robot link."""

from __future__ import annotations

from typing import Any

from gaponet.cli.out import Out
from gaponet.hw.drivers.link import measure_link
from gaponet.hw.drivers.open import open_driver


def listen(out: Out, kind: str, name: str, options: dict[str, Any], seconds: float) -> None:
    """How a robot's states arrive, and who publishes what; nothing is sent."""
    driver = open_driver(kind, name, **options)
    try:
        driver.connect()
        found = measure_link(driver, seconds)
        publishers = driver.publishers() if hasattr(driver, "publishers") else {}
    finally:
        driver.close(hold=True)
    three = lambda what: ", ".join(f"{value:.2f}" for value in found[what])  # noqa: E731
    out.table(f"{'VIRTUAL ' * driver.virtual}{name} at {driver.address}, {seconds:g} s", ["what", "value"], [
        ["states, a second", f"{found['states']}, {found['rate_hz']:.1f}"],
        ["age when it comes, ms: p50, p99, max", three("age_ms")],
        ["between two, ms: p50, p99, max", three("interval_ms")],
        ["lost, refused", f"{found['lost']}, {found['refused']}"],
        *([f"publish {topic}", "; ".join(programs) or "nobody"] for topic, programs in publishers.items()),
    ])  # fmt: skip
    out.result(found | {"publishers": publishers, "virtual": driver.virtual} | driver.facts)
