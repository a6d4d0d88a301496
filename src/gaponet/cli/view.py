"""gaponet view."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gaponet.base.progress import progress_bar
from gaponet.cli.options import Data, Json, Robot
from gaponet.cli.out import Out
from gaponet.evaluation.methods import title
from gaponet.evaluation.tables import mrad
from gaponet.nn.packaged_networks import named_folder
from gaponet.sim.dataset_robot import open_dataset

if TYPE_CHECKING:
    from gaponet.data.sequence import SequenceMeta
    from gaponet.report.view.scene import Scene
    from gaponet.report.view.side_by_side import Clip


def view(
    dataset: Data, model: tuple[Path, ...] = (), motion: str = "", unit: str = "", payload_mass: float | None = None,
    show: tuple[str, ...] = ("target", "nominal", "aligned", "recorded"), render: Path | None = None, port: int = 8080,
    start: float | None = None, duration: float = 8.0, speed: float = 1.0, magnify: float = 1.0, closeup: bool = False,
    fps: float = 20.0, width: int = 960, azimuth: float = 145.0, elevation: float = -14.0, robot: Robot = None,
    json: Json = False,
) -> None:  # fmt: skip
    """Watch a recording beside its simulations: browser, film.

    Args:
        model: Robot folders of gaponet identify, run folders of gaponet train, or networks of the package by name; each
            adds a copy of the robot.
        motion: Motion name. Default: one that the model was not trained on, if there is one.
        unit: Unit, where several recorded the motion.
        payload_mass: Payload of the recording, kg.
        show: Copies of the robot from left to right; aligned means the identified robot and every --model.
        render: Write a .gif, .mp4 or .png, and open no browser (.png: the moment of the largest nominal error).
        port: Port of the browser's page, on this machine.
        start: Start within the recording, s. Default: the part with the most motion.
        duration: Duration, s of the recording.
        speed: Below 1 is slow motion.
        magnify: Factor of the differences from the recording, to make milliradians visible; the picture states it.
        closeup: Frame the operated limbs; others, such as a humanoid's legs, may be cut off.
        fps: Pictures a second of a film.
        width: Width of a picture, pixels; the height follows from the robots.
        azimuth: Camera, degrees; 180 looks at the robot's front.
        elevation: Camera, degrees; negative looks down.
    """
    if render is not None:
        _require_renderer(render)
    from gaponet.report.view.scene import Scene, View
    from gaponet.report.view.side_by_side import Clip, select_entry, side_by_side

    out = Out(json)
    model = tuple(named_folder(folder) for folder in model)
    data, spec = open_dataset(dataset, robot, model[0] if model else None)
    entry = select_entry(
        data, model if spec.nominal is None else (*model, spec.folder), motion, unit, payload_mass
    )
    with progress_bar("replaying") as update:
        shown = side_by_side(data, entry, spec, model, update)
    shown = shown.only(
        tuple(n for n in show if n != "aligned" or model or spec.nominal is not None)
    )
    clip = Clip.from_start(shown, start, duration, speed, fps)
    errors = {m.method: m.mpjae for m in shown.motions if m.method != "recorded"}
    _introduce(
        out,
        entry.meta,
        {title(m.method): m.mpjae for m in shown.motions if m.method in errors},
        shown.seen,
    )
    rows = slice(round(clip.start / shown.real.dt), round(clip.stop / shown.real.dt) + 1)
    scene = Scene(
        shown.magnified(magnify), View(azimuth, elevation), rows, render is not None, closeup
    )
    if render is not None:
        _film(scene, clip, render, width, magnify, out)
    else:
        from gaponet.report.view.app import serve_dataset

        serve_dataset(data, scene, clip, port, magnify, out.say)
    out.result({
        "sequence": entry.id, "virtual": entry.meta.virtual, "seen": shown.seen, "start": clip.start,
        "duration": clip.duration, "mpjae": errors, "render": None if render is None else str(render),
    })  # fmt: skip


def _require_renderer(render: Path) -> None:
    """Refuse a file that cannot be rendered before anything is simulated."""
    from gaponet.report.view.gl import choose_gl

    choose_gl()
    from gaponet.report.view.picture import require_writable

    require_writable(render)


def _introduce(out: Out, meta: SequenceMeta, errors: dict[str, float], seen: bool | None) -> None:
    errors_text = ", ".join(f"{name} {mrad(error)} mrad" for name, error in errors.items())
    kind = "VIRTUAL " if meta.virtual else ""
    out.say(f", {kind}unit {meta.unit_id}, {meta.payload_mass:g} kg; {errors_text}", meta.motion)
    if seen:
        out.say(
            "",
            "a model was trained or chosen on this recording: its error is no test error",
            "yellow",
        )


def _film(scene: Scene, clip: Clip, path: Path, width: int, magnify: float, out: Out) -> None:
    from gaponet.report.view.picture import Camera, write

    with Camera(scene, clip, width, magnify) as camera, progress_bar("rendering") as update:
        pictures = write(camera, path, lambda done, total: update(done, total, "pictures"))
    out.say(f"{path}: {pictures} picture{'s' * (pictures > 1)}, {path.stat().st_size / 1e6:.2f} MB")
