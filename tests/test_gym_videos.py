"""Videos and windows of the environments, by Gymnasium's own wrappers and what the extra `[film]` installs."""

from __future__ import annotations

import subprocess
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import animat  # noqa: F401 - its import registers the environments


# MoviePy 1 compares strings by identity; Python says so when it compiles it.
@pytest.mark.filterwarnings("ignore::SyntaxWarning")
def test_record_video_films_every_iteration(tmp_path: Path) -> None:
    pytest.importorskip("moviepy", reason="MoviePy is not installed (animat[film])")
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed (animat[film])")
    env = gymnasium.make("Animat/Navigation-v0", render_mode="rgb_array")
    env = gymnasium.wrappers.RecordVideo(env, str(tmp_path / "videos"), episode_trigger=lambda episode: episode == 1)
    for seed in (0, 1):
        env.reset(seed=seed)
        pictures = [env.unwrapped.render()]
        for _ in range(8):
            env.step(4)
            pictures.append(env.unwrapped.render())
    env.close()
    (film,) = (tmp_path / "videos").glob("*.mp4")
    decode = [ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(film), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(decode, capture_output=True, check=True).stdout
    shown = np.frombuffer(raw, np.uint8).reshape(-1, *pictures[0].shape)
    assert len(shown) == len(pictures) == 9
    # The codec loses some colour.
    for frame, picture in zip(shown, pictures, strict=True):
        assert np.abs(frame.astype(int) - picture).mean() < 3
    assert np.abs(shown[0].astype(int) - pictures[-1]).mean() > np.abs(shown[0].astype(int) - pictures[0]).mean()


def test_human_rendering_shows_the_pictures_in_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    pygame = pytest.importorskip("pygame", reason="pygame-ce is not installed (animat[film])")
    with pytest.warns(UserWarning, match="HumanRendering"):
        env = gymnasium.make("Animat/Navigation-v0", render_mode="human")
    env.reset(seed=0)
    env.step(4)
    window = env.window
    np.testing.assert_array_equal(pygame.surfarray.array3d(window).swapaxes(0, 1), env.unwrapped.render())
    env.close()
