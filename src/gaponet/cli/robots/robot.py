"""gaponet robot check, gaponet robot list, gaponet robot link."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from gaponet.cli.options import Json
from gaponet.cli.out import Out, show_findings
from gaponet.data.store import open_dataset
from gaponet.errors import UsageError
from gaponet.robot import RobotSpec, available, load_robot

POSTURES = 300  # of the logs


def robot(
    action: tyro.conf.Positional[Literal["check", "list", "link"]],
    path: tyro.conf.Positional[str] = "",
    driver: Literal["unitree", "so101"] = "unitree",
    domain: int = 0,
    interface: str = "lo",
    port: str = "/dev/ttyACM0",
    seconds: float = 5.0,
    data: Path | None = None,
    payloads: tuple[float, ...] = (),
    json: Json = False,
) -> None:
    """List the package's robots, step one to say what is wrong with it, or listen to a robot without moving it.

    Args:
        action: check, list or link.
        path: For check and link: robot name, or a folder with robot.toml and robot.xml.
        driver: link: unitree (DDS) or so101 (serial).
        domain: link, unitree: DDS domain.
        interface: link, unitree: network interface to the robot.
        port: link, so101: serial port.
        seconds: link: how long to listen.
        data: check: dataset of this robot, whose postures and payloads are looked at.
        payloads: check: kg in every mount, each held for a minute; default those of the data, or 0.
    """
    out = Out(json)
    if action == "list":
        list_robots(out)
    elif action == "link":
        options = {"domain": domain, "interface": interface, "silent": True} if driver == "unitree" else {"port": port}
        listen(out, driver, path or ("h1_2" if driver == "unitree" else "so101"), options, seconds)
    elif not path:
        raise UsageError(f"gaponet robot check needs a robot name ({', '.join(available())}) or a folder")
    else:
        check_robot(out, load_robot(path), data, payloads)


def list_robots(out: Out) -> None:
    """Robots in the package."""
    specs = [load_robot(name) for name in available()]
    out.table("Robots", ["name", "joints", "operated", "Hz", "payload", "what it is"], [
        [s.name, str(len(s.joint_names)), str(len(s.operated)), f"{1 / s.dt:g}",
         ", ".join(m.side for m in s.payload_mounts) or "–", s.description] for s in specs
    ])  # fmt: skip
    out.say("Your own: a folder with robot.toml and robot.xml; gaponet robot check FOLDER")
    out.result({"robots": [{"name": s.name, "joints": s.joint_names, "operated": s.operated} for s in specs]})


def listen(out: Out, kind: str, name: str, options: dict[str, Any], seconds: float) -> None:
    """How a robot's states arrive, and who publishes what; nothing is sent."""
    from gaponet.deploy.drivers.link import measure
    from gaponet.deploy.drivers.open import open_driver

    driver = open_driver(kind, name, **options)
    try:
        driver.connect()
        found = measure(driver, seconds)
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


def check_robot(out: Out, spec: RobotSpec, dataset: Path | None = None, payloads: tuple[float, ...] = ()) -> None:
    """Step the robot; a broken one raises RobotError, a doubtful one gets warnings."""
    from gaponet.sim.model import model_hash
    from gaponet.sim.setup.check import check_robot

    postures = None
    if dataset is not None:
        data, _ = open_dataset(dataset, spec)
        payloads = payloads or tuple(sorted({e.meta.payload_mass for e in data.entries}))
        rows = np.concatenate([data.read(e).qpos for e in data.entries])
        postures = rows[:: max(1, len(rows) // POSTURES)].astype(float)
    findings = check_robot(spec, payloads or (0.0,), postures)
    out.table(f"{spec.name}: {spec.description}; N·m/rad, N·m·s/rad, N·m, rad",
              ["joint", "operated", "kp", "kd", "limit", "range"], [
        [name, "yes" if name in spec.operated else "no", f"{spec.kp[i]:g}", f"{spec.kd[i]:g}",
         f"{spec.effort_limit[i]:g}", "{:.2f}…{:.2f}".format(*spec.qpos_range[i])]
        for i, name in enumerate(spec.joint_names)
    ])  # fmt: skip
    for name, unit in zip(spec.joint_names, spec.log_units, strict=True):
        if unit != "rad":
            out.say(f"{name} is expected as {unit} in SAGE logs")
    mounts = ", ".join(f"{m.side} on {m.body}" for m in spec.payload_mounts) or "none"
    out.say(
        f"control period {spec.dt * 1e3:g} ms, physics step {spec.timestep * 1e3:g} ms ({spec.decimation} a period); "
        f"payload mounts: {mounts}; contacts {'on' if spec.contacts else 'off'}; simulator {model_hash(spec)}"
    )
    show_findings(out, findings)
    bad = {level: sum(f.level == level for f in findings) for level in ("error", "warning")}
    if bad["error"]:
        out.say(f": {spec.name} is no simulator of it yet; mend the {bad['error']} error(s)", "not ok", "bold red")
    elif bad["warning"]:
        out.say(f"{spec.name} compiles and holds; see the {bad['warning']} warning(s)")
    else:
        out.say(f": {spec.name} compiles, holds its home and is stable", "ok", "bold green")
    warnings = [f.message for f in findings if f.level in bad]
    out.result(as_dict(spec) | {"simulator_hash": model_hash(spec), "warnings": warnings,
                                "findings": [vars(f) for f in findings]})  # fmt: skip


def as_dict(spec: RobotSpec) -> dict[str, Any]:
    """The check as a dictionary that JSON can hold."""
    return {
        "name": spec.name, "dt": spec.dt, "timestep": spec.timestep,
        "joints": [
            {"name": name, "operated": name in spec.operated, "kp": spec.kp[i], "kd": spec.kd[i],
             "effort_limit": spec.effort_limit[i], "range": spec.qpos_range[i], "home": spec.qpos_home[i],
             "log_unit": spec.log_units[i]}
            for i, name in enumerate(spec.joint_names)
        ],
        "payload_mounts": [{"side": m.side, "body": m.body, "pos": m.pos} for m in spec.payload_mounts],
    }  # fmt: skip
