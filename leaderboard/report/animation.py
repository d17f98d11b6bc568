"""Animation of a drive for the README and for users.

The suspension is in ride mode for the first half and in handling mode for the second, so that the
difference is visible. The animation runs in real time, one frame per control interval.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

import road_envs
from road_envs.core.atomic_io import atomic_write
from road_envs.core.config import ConfigError
from road_envs.core.extras import optional_import

if TYPE_CHECKING:
    from PIL.Image import Image

ANIMATION_FORMATS = {".gif": "GIF", ".webp": "WEBP"}
"""Pillow formats by file suffix."""

EDGE_TOLERANCE = 40
"""Largest error, of 255, of an edge pixel kept from the last frame of a GIF, to save space."""

SEED = 0

Progress = Callable[[str, float], None]
"""Callback with a description of the current work and the share of the work done."""


def animate(
    env_options: Mapping[str, Any],
    seconds: float,
    path: str | Path,
    progress: Progress = lambda text, share: None,
) -> None:
    """Drive up to `seconds` of `RoadRecon-v0` and write the frames to `path` as an endless loop.

    `env_options` are options of the environment. The file is written atomically. Raises ConfigError
    if the suffix is not in ANIMATION_FORMATS, for less than two frames, and for invalid options.
    """
    path = Path(path)
    if path.suffix.lower() not in ANIMATION_FORMATS:
        raise ConfigError(f"{path}: the suffix must be {' or '.join(ANIMATION_FORMATS)}")
    env = gymnasium.make(road_envs.ID, **{**env_options, "render_mode": "rgb_array"})
    rate = env.metadata["render_fps"]
    total = round(seconds * rate)
    if total < 2:
        raise ConfigError(f"an animation needs at least {2 / rate:g} s, got {seconds:g} s")
    _save(_drive(env, total, progress), path, rate)
    progress("done", 1.0)


def _drive(env: gymnasium.Env, total: int, progress: Progress) -> Iterator[np.ndarray]:
    """Yield up to `total` frames of an episode: ride mode, then from the middle handling mode."""
    env.reset(seed=SEED)
    handling = int(env.action_space.n) - 1  # type: ignore[attr-defined]
    over = False
    for k in range(total):
        if over:
            return
        progress("driving", k / total)
        yield env.render()  # type: ignore[misc]
        *_, terminated, truncated, _ = env.step(handling if 2 * k >= total else 0)
        over = terminated or truncated


def _save(frames: Iterator[np.ndarray], path: Path, rate: float) -> None:
    with optional_import("a picture"):
        from PIL import Image

    kind = ANIMATION_FORMATS[path.suffix.lower()]
    images = _quantized(frames) if kind == "GIF" else map(Image.fromarray, frames)
    first = next(images)
    options = {"save_all": True, "append_images": images, "duration": 1000.0 / rate, "loop": 0}
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial:
        first.save(partial, kind, optimize=True, **options)


def _quantized(frames: Iterator[np.ndarray]) -> Iterator["Image"]:
    """Yield frames in the renderer's palette; edge pixels keep the last value if it is close."""
    with optional_import("a picture"):
        from PIL import Image

    from road_envs.rendering.style import palette

    colours = Image.new("P", (1, 1))
    colours.putpalette(palette())
    values = np.array(palette(), dtype=np.int16).reshape(-1, 3)
    last = None
    for frame in frames:
        nearest = np.asarray(
            Image.fromarray(frame).quantize(palette=colours, dither=Image.Dither.NONE)
        )
        if last is None:
            last = nearest
        at_edge = (frame != values[nearest]).any(axis=2)
        off = np.abs(frame - values[last]).max(axis=2)
        last = np.where(at_edge & (off <= EDGE_TOLERANCE), last, nearest)
        image = Image.fromarray(last)
        image.putpalette(palette())
        yield image
