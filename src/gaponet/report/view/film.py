"""Films and pictures of a scene: GIF and PNG through Pillow, MP4 through imageio-ffmpeg."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.base.errors import UsageError
from gaponet.base.files import atomic_write
from gaponet.report.view.picture import Camera
from gaponet.report.view.side_by_side import largest_error_time

if TYPE_CHECKING:
    from PIL.Image import Image

GIF_COLOURS = 200  # shared by all frames
SUFFIXES = (".gif", ".mp4", ".png")


def require_writable(path: Path) -> None:
    """Refuse an unknown file suffix, a missing folder or a missing library before any work is done."""
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"--render {path}: name a file that ends in {', '.join(SUFFIXES)}")
    if not path.parent.is_dir():
        raise UsageError(f"--render {path}: there is no folder {path.parent}; make it first")
    if importlib.util.find_spec("PIL") is None:
        raise UsageError("--render needs Pillow; run: pip install 'gaponet[view]'")
    if path.suffix.lower() == ".mp4":
        _ffmpeg()


def write(camera: Camera, path: Path, progress: Callable[[int, int], None] = lambda i, n: None) -> int:
    """Render to a file; a PNG shows the moment of the largest error of the first simulated copy.

    Returns:
        Number of pictures.
    """
    require_writable(path)
    clip, suffix = camera.clip, path.suffix.lower()
    hundredths = max(round(100 / clip.fps), 2)  # a GIF counts in 1/100 s, and viewers slow down below 2
    times = clip.times(hundredths / 100 if suffix == ".gif" else 1 / clip.fps)

    def pictures() -> Iterator[Image]:
        for i, time in enumerate(times):
            yield camera.picture(float(time))
            progress(i + 1, len(times))

    with atomic_write(path) as temporary:
        if suffix == ".gif":
            _write_gif(list(pictures()), temporary, 10 * hundredths)
        elif suffix == ".mp4":
            _write_mp4(pictures(), temporary, clip.fps, (camera.width, camera.height))
        else:
            camera.picture(largest_error_time(camera.scene.shown, clip)).save(temporary)
    return 1 if suffix == ".png" else len(times)


def _write_gif(pictures: list[Image], path: Path, milliseconds: int) -> None:
    """Write with one palette for all frames and no dithering, which keeps the file small."""
    from PIL.Image import Dither, Quantize, fromarray

    sample = np.concatenate([np.asarray(p) for p in pictures[:: max(len(pictures) // 4, 1)]])
    palette = fromarray(sample).quantize(GIF_COLOURS, Quantize.MAXCOVERAGE)
    frames = [p.quantize(palette=palette, dither=Dither.NONE) for p in pictures]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=milliseconds, loop=0, optimize=True)


def _write_mp4(pictures: Iterator[Image], path: Path, fps: float, size: tuple[int, int]) -> None:
    writer = _ffmpeg().write_frames(str(path), size, fps=fps, quality=7, macro_block_size=2)
    writer.send(None)
    try:
        for picture in pictures:
            writer.send(picture.tobytes())
    finally:
        writer.close()


def _ffmpeg() -> Any:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise UsageError("MP4 needs imageio-ffmpeg; run: pip install 'gaponet[view]', or render a .gif") from None
    return imageio_ffmpeg
