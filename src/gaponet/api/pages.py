"""Reports, lists of runs, and pages in the browser: what gaponet report, view and app do."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gaponet.api.opening import Place, as_run, open_dataset
from gaponet.base.errors import UsageError
from gaponet.base.progress import Progress, no_progress
from gaponet.robot.folder import load_stored_robot
from gaponet.robot.spec import RobotSpec

if TYPE_CHECKING:
    from gaponet.data.store import Dataset, Entry
    from gaponet.report.view.scene import Scene
    from gaponet.report.view.side_by_side import Clip, SideBySide


# ---- reports


@dataclass(frozen=True, kw_only=True)
class ReportResult:
    """A page about an identified robot or a run.

    Attributes:
        methods: Method → its metrics.
        dataset: Dataset of the evaluation.
    """

    path: Path
    methods: dict[str, Any] = field(repr=False)
    dataset: str

    def to_dict(self) -> dict[str, Any]:
        return {"report": str(self.path)}


@dataclass(frozen=True, kw_only=True)
class TrainedRun:
    """Facts from the files of a run; None for what is not written yet.

    Attributes:
        run: Folder below the searched one; " V" behind it if it was trained on VIRTUAL robots.
        model: Method of its network.
        val_mpjae, test_mpjae: Errors on validation and test motions, rad, and their ratios to the
            nominal simulator's.
        evaluated_on: Dataset of the evaluation.
    """

    run: str
    model: str
    seed: int
    robot: str
    virtual: bool
    dataset_hash: str
    simulator: str | None
    hours: float | None
    steps: int | None
    seconds: float | None
    finished: bool
    val_mpjae: float | None
    val_ratio: float | None
    evaluated_on: str | None
    test_mpjae: float | None
    test_ratio: float | None

    @property
    def order(self) -> float:
        """Ratio by which runs are sorted, the best first."""
        return math.inf if self.val_ratio is None else self.val_ratio

    @classmethod
    def of_folder(cls, run: Path, below: Path) -> TrainedRun:
        """Read the facts of a run."""
        from gaponet.evaluation.methods import method
        from gaponet.evaluation.run_files import read_config, read_metrics
        from gaponet.nn.artifact import CARD, GapModel

        config = read_config(run)
        last = _last_line(run)
        card_file = run / "model" / CARD
        card = GapModel.read_card(card_file)[0] if card_file.is_file() else {}
        metrics = read_metrics(run) if (run / "metrics.json").is_file() else {}
        unfinished = {"model": last.get("best"), "nominal": last.get("nominal_mpjae")}
        val = card.get("val_mpjae", unfinished)
        own = method(config["model"]["kind"], load_stored_robot(run, config["robot"]))
        measured = metrics.get("methods", {}).get(own, {})
        virtual = bool(card.get("virtual", False))
        mark = " V" if virtual else ""
        has_ratio = val["model"] and val["nominal"]
        return cls(
            run=f"{run.relative_to(below)}{mark}",
            model=own,
            seed=config["seed"],
            robot=config["robot"],
            virtual=virtual,
            dataset_hash=config["dataset_hash"],
            simulator=card.get("simulator"),
            hours=card.get("hours"),
            steps=card.get("steps", last.get("steps")),
            seconds=card.get("seconds", last.get("seconds")),
            finished=bool(card) and not card.get("interrupted", False),
            val_mpjae=val["model"],
            val_ratio=val["model"] / val["nominal"] if has_ratio else None,
            evaluated_on=metrics.get("dataset"),
            test_mpjae=measured.get("mpjae"),
            test_ratio=metrics.get("ratio_to_nominal", {}).get(own),
        )

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def _last_line(run: Path) -> dict[str, Any]:
    """Return the newest line of a training curve, with the best validation error so far."""
    from gaponet.evaluation.run_files import read_progress

    lines = read_progress(run)
    if not lines:
        return {}
    best = min(line["val_mpjae"] for line in lines)
    return lines[-1] | {"best": best}


def write_report(
    run: Place,
    *,
    dataset: Place | None = None,
    robot: str | None = None,
    progress: Progress = no_progress,
) -> ReportResult:
    """Write one offline HTML page about an identified robot or a run, into its folder.

    Args:
        run: Robot folder, or run folder of `train`.
        dataset: Evaluate on this first. Default: the newest evaluation, or the test motions.
        robot: Robot name or folder, if not the one that the run stores.

    Raises:
        ModelError, DatasetError: The folder is damaged, or the dataset is not there.
    """
    from gaponet.report.view.gl import prepare

    prepare()  # before MuJoCo is imported
    from gaponet.evaluation.run_files import read_metrics
    from gaponet.report import report
    from gaponet.report.view.picture import portrait

    folder = Path(run)
    place = None if dataset is None else Path(dataset)
    path = report.write_report(folder, place, robot, progress, portrait)
    metrics = read_metrics(folder)
    return ReportResult(
        path=path, methods=metrics["methods"], dataset=str(dataset or metrics["dataset"])
    )


def trained_runs(folder: Place) -> list[TrainedRun]:
    """Return the training runs in a folder and below it, best first.

    Raises:
        UsageError: There is none.
        ModelError: One is damaged.
    """
    root = Path(folder)
    runs = []
    for config in sorted(root.rglob("config.json")):
        if (config.parent / "split.json").is_file():
            runs.append(TrainedRun.of_folder(config.parent, root))
    if not runs:
        raise UsageError(
            f"{root}: no run here or below (a run has config.json and split.json); train one first"
        )
    return sorted(runs, key=lambda run: run.order)


# ---- the recording beside its simulations


@dataclass(frozen=True)
class ViewOptions:
    """Which recording is shown, beside what, and how."""

    model: tuple[Path, ...] = ()
    """Robot folders of gaponet identify, run folders of gaponet train, or networks of the package
    by name; each adds a copy of the robot."""
    motion: str = ""
    """Motion name. Default: one that the model was not trained on, if there is one."""
    unit: str = ""
    """Unit, where several recorded the motion."""
    payload_mass: float | None = None
    """Payload of the recording, kg."""
    show: tuple[str, ...] = ("target", "nominal", "aligned", "recorded")
    """Copies of the robot from left to right; aligned means the identified robot and every
    --model."""
    start: float | None = None
    """Start within the recording, s. Default: the part with the most motion."""
    duration: float = 8.0
    """Duration, s of the recording."""
    speed: float = 1.0
    """Below 1 is slow motion."""
    magnify: float = 1.0
    """Factor of the differences from the recording, to make milliradians visible; the picture
    states it."""
    closeup: bool = False
    """Frame the operated limbs; others, such as a humanoid's legs, may be cut off."""
    fps: float = 20.0
    """Pictures a second of a film."""
    width: int = 960
    """Width of a picture, pixels; the height follows from the robots."""
    azimuth: float = 145.0
    """Camera, degrees; 180 looks at the robot's front."""
    elevation: float = -14.0
    """Camera, degrees; negative looks down."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A recording beside its simulations, ready to be watched or rendered.

    Attributes:
        entry: The recording.
        shown: Its motions.
        for_film: Whether it is rendered, or shown in a browser.
    """

    dataset: Dataset
    entry: Entry
    shown: SideBySide = field(repr=False)
    clip: Clip
    options: ViewOptions
    for_film: bool

    @property
    def errors(self) -> dict[str, float]:
        """Method → mean |error|, rad."""
        motions = self.shown.motions
        return {m.method: m.mpjae for m in motions if m.method != "recorded"}

    def scene(self) -> Scene:
        """Return the robots beside each other."""
        from gaponet.report.view.scene import Scene, View

        dt = self.shown.real.dt
        rows = slice(round(self.clip.start / dt), round(self.clip.stop / dt) + 1)
        view = View(self.options.azimuth, self.options.elevation)
        motions = self.shown.magnified(self.options.magnify)
        return Scene(motions, view, rows, self.for_film, self.options.closeup)

    def serve(self, port: int, say: Callable[[str], None]) -> None:
        """Serve the page of the dataset until Ctrl-C; `say` is told its address."""
        from gaponet.report.view.app import serve_dataset

        serve_dataset(self.dataset, self.scene(), self.clip, port, self.options.magnify, say)

    def render(self, file: Place, progress: Progress = no_progress) -> int:
        """Write a .gif, .mp4 or .png; return the number of pictures."""
        from gaponet.report.view.picture import Camera, write

        def report(done: int, total: int) -> None:
            progress(done, total, "pictures")

        options = self.options
        with Camera(self.scene(), self.clip, options.width, options.magnify) as camera:
            return write(camera, Path(file), report)

    def to_dict(self) -> dict[str, Any]:
        return {
            "sequence": self.entry.id,
            "virtual": self.entry.meta.virtual,
            "seen": self.shown.seen,
            "start": self.clip.start,
            "duration": self.clip.duration,
            "mpjae": self.errors,
        }


def compare(
    dataset: Dataset | Place,
    *,
    robot: RobotSpec | Place | None = None,
    options: ViewOptions = ViewOptions(),
    render: Place | None = None,
    progress: Progress = no_progress,
) -> Comparison:
    """Simulate a recording for a picture of it beside its simulations.

    Args:
        dataset: Recordings.
        robot: Another robot than the one that the dataset keeps.
        options: Which recording is shown, beside what, and how.
        render: File that will be rendered; it is refused before anything is simulated.

    Raises:
        UsageError: The file cannot be rendered here, or an option is out of range.
        DatasetError: No recording matches.
    """
    if render is not None:
        _require_renderer(Path(render))
    from gaponet.report.view.side_by_side import Clip, select_entry, side_by_side

    models = tuple(as_run(folder) for folder in options.model)
    data, spec = open_dataset(dataset, robot, models[0] if models else None)
    candidates = (*models, spec.folder) if spec.is_identified else models
    entry = select_entry(data, candidates, options.motion, options.unit, options.payload_mass)
    shown = side_by_side(data, entry, spec, models, progress)
    copies = options.show
    if not candidates:
        copies = tuple(name for name in copies if name != "aligned")
    shown = shown.only(copies)
    clip = Clip.from_start(shown, options.start, options.duration, options.speed, options.fps)
    return Comparison(
        dataset=data,
        entry=entry,
        shown=shown,
        clip=clip,
        options=options,
        for_film=render is not None,
    )


def _require_renderer(file: Path) -> None:
    """Refuse a file that cannot be rendered."""
    from gaponet.report.view.gl import choose_gl

    choose_gl()  # before MuJoCo is imported
    from gaponet.report.view.picture import require_writable

    require_writable(file)


# ---- the page with all steps


def serve_app(
    folder: Place, *, port: int, outside: tuple[Place, ...] = (), say: Callable[[str], None] = print
) -> None:
    """Serve the page with all steps from logs to an identified simulator, until Ctrl-C.

    Args:
        folder: Folder for logs, models and results.
        port: Port on this machine; the next free one is taken.
        outside: Other folders that the results in `folder` may use.
        say: Told the address, which holds a secret.

    Raises:
        FolderError: The folder holds something else, or another page serves it.
    """
    from gaponet.base.files import lock_folder
    from gaponet.report.view.app import App, serve

    place = Path(folder)
    with lock_folder(place, "app"):
        allowed = tuple(Path(path).resolve() for path in outside)
        serve(App(place.resolve(), port, allowed), say)
