"""gaponet robot check, gaponet robot list, gaponet robot link."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import tyro

from gaponet.cli.options import Json
from gaponet.cli.out import Out
from gaponet.errors import UsageError
from gaponet.robot import RobotSpec, available, load_robot


def robot(
    action: tyro.conf.Positional[Literal["check", "list", "link"]],
    path: tyro.conf.Positional[str] = "",
    driver: Literal["unitree", "so101"] = "unitree",
    domain: int = 0,
    interface: str = "lo",
    port: str = "/dev/ttyACM0",
    seconds: float = 5.0,
    json: Json = False,
) -> None:
    """List the package's robots, say what is wrong with a robot folder, or listen to a robot without moving it.

    Args:
        action: check, list or link.
        path: For check and link: robot name, or a folder with robot.toml and robot.xml.
        driver: link: unitree (DDS) or so101 (serial).
        domain: link, unitree: DDS domain.
        interface: link, unitree: network interface to the robot.
        port: link, so101: serial port.
        seconds: link: how long to listen.
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
        check_robot(out, load_robot(path))


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


def check_robot(out: Out, spec: RobotSpec) -> None:
    """Compile the robot with and without a payload; a broken one raises RobotError, a doubtful one gets warnings."""
    from gaponet.sim.dynamics import static_torque
    from gaponet.sim.model import build_model, model_hash

    model = build_model(spec)
    if spec.payload_mounts:
        build_model(spec, 1.0)
    load = static_torque(model, spec.qpos_home[None])[0]
    warnings = doubts(spec, load)
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
        f"payload mounts: {mounts}; simulator {model_hash(spec)}"
    )
    for warning in warnings:
        out.say(f"  {warning}", "warning", "yellow")
    if warnings:
        out.say(f"{spec.name} compiles; see the warnings")
    else:
        out.say(f": {spec.name} compiles", "ok", "bold green")
    out.result(as_dict(spec) | {"simulator_hash": model_hash(spec), "warnings": warnings})


def doubts(spec: RobotSpec, load: np.ndarray) -> list[str]:
    """What compiles and is still likely a mistake. load: holding torque at home, (n), N·m."""
    found = []
    for i, name in enumerate(spec.joint_names):
        low, high = spec.qpos_range[i]
        if spec.kp[i] <= 0:
            found.append(f"{name}: kp is {spec.kp[i]:g}; a position-controlled joint needs kp > 0")
        if not low <= spec.qpos_home[i] <= high:
            found.append(f"{name}: home {spec.qpos_home[i]:g} lies outside its range [{low:.2f}, {high:.2f}]")
        if not np.isfinite(low):
            found.append(
                f"{name}: has no range in the MJCF; commands are not clipped and doctor cannot judge positions"
            )
        if abs(load[i]) > spec.effort_limit[i]:
            found.append(
                f"{name}: needs {abs(load[i]):.3g} N·m to hold its home, its limit is {spec.effort_limit[i]:g}"
            )
    if not spec.payload_mounts:
        found.append("no [[payload_mount]]: payloads other than 0 will be refused")
    return found


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
