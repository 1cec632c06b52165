"""A scene as a film: GIF by Pillow, MP4 by the ffmpeg of imageio-ffmpeg (extra `[film]`)."""

from __future__ import annotations

import errno
import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

from PIL import Image

from animat.errors import InvalidArgument
from animat.extras import install_command
from animat.progress import Progress, Silent
from animat.report.film.frame import HEIGHT_PX, WIDTH_PX, Frames, pictures_of
from animat.report.film.scene import Scene
from animat.robots.drawing import ACCENT, BODY, GOAL, GOAL_FILL, INK, RAIL, TRAIL
from animat.writing import atomic_write, expect_writable

FRAMES_PER_S = {".mp4": 25, ".gif": 10}
"""By the film's suffix."""
_COLOURS = 96
"""Of a GIF."""
_ROBOTS = (ACCENT, BODY, GOAL, GOAL_FILL, INK, RAIL, TRAIL)
"""Colours of robots, which need not be in the first frame."""


def check_film(path: str | os.PathLike[str]) -> None:
    """Refuse, before any work, another suffix, a missing package for MP4, and a folder that cannot be written to."""
    path = Path(path)
    if path.suffix.lower() not in FRAMES_PER_S:
        raise InvalidArgument(f"{path}: expected a film's name to end in .mp4 or .gif, got {path.suffix!r}")
    if path.is_dir():
        raise InvalidArgument(f"{path}: expected a file for the film, got a folder")
    if path.suffix.lower() == ".mp4" and find_spec("imageio_ffmpeg") is None:
        raise InvalidArgument(
            f"{path}: expected the package imageio-ffmpeg for an MP4, which is not installed: "
            f"{install_command('film')}, or end the name in .gif"
        )
    expect_writable(path.parent)


def write_film(scene: Scene, path: str | os.PathLike[str], progress: Progress | None = None) -> Path:
    """Film a scene in real time, as .mp4 or .gif (`check_film`), atomically; InvalidFile if it cannot be written."""
    path = Path(path)
    kind, frames = path.suffix.lower(), Frames(scene, pictures_of(scene))
    pictures = _pictures(scene, frames, FRAMES_PER_S[kind], progress or Silent())
    with atomic_write(path) as beside:
        if kind == ".gif":
            _write_gif(pictures, frames.colours, beside)
        else:
            _write_mp4(pictures, beside)
    return path


def _pictures(scene: Scene, frames: Frames, frames_per_s: int, progress: Progress) -> Iterator[Image.Image]:
    n = max(1, round((scene.stop_s - scene.start_s) * frames_per_s))
    for number in range(n):
        yield frames.at(scene.start_s + number / frames_per_s)
        progress.update(number + 1, n)


def _write_gif(pictures: Iterator[Image.Image], colours: Sequence[str], path: Path) -> None:
    first = next(pictures)
    # One palette for all frames, without dithering, so that unchanged pixels cost nothing.
    swatches: list[str | tuple[int, int, int]] = [*colours, *_ROBOTS]
    every = Image.new("RGB", (first.width, first.height + 20 * len(swatches)))
    every.paste(first)
    for number, colour in enumerate(swatches):
        row = first.height + 20 * number
        every.paste(colour, (0, row, first.width, row + 20))
    palette = every.quantize(_COLOURS, Image.Quantize.MEDIANCUT)
    # One at a time, as all frames of a long film would not fit into memory.
    indexed = (each.quantize(palette=palette, dither=Image.Dither.NONE) for each in chain([first], pictures))
    start = next(indexed)
    ms = 1000 // FRAMES_PER_S[".gif"]
    start.save(path, "GIF", save_all=True, append_images=indexed, duration=ms, loop=0, optimize=True)


def _write_mp4(pictures: Iterator[Image.Image], path: Path) -> None:
    from imageio_ffmpeg import get_ffmpeg_exe

    # imageio's own writer forks, which a process with JAX's threads must not do.
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{WIDTH_PX}x{HEIGHT_PX}", "-r", str(FRAMES_PER_S[".mp4"])]
    output = ["-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path.absolute())]
    command = [get_ffmpeg_exe(), "-y", "-loglevel", "error", *source, "-i", "-", *output]
    pipe = subprocess.PIPE
    # In a new session, so that Ctrl-C does not reach ffmpeg.
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, start_new_session=True) as ffmpeg:
        assert ffmpeg.stdin is not None
        try:
            # If ffmpeg ends early, its message is in the error below.
            with suppress(BrokenPipeError):
                for picture in pictures:
                    ffmpeg.stdin.write(picture.tobytes())
            _, message = ffmpeg.communicate()
        except BaseException:
            ffmpeg.kill()
            raise
    if ffmpeg.returncode:
        full = os.strerror(errno.ENOSPC)
        said = message.decode(errors="replace").split()
        # The caller names the file; what ffmpeg says of a full disk is long.
        raise OSError(full if full in " ".join(said) else " ".join(said))
