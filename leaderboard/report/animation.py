"""A drive as a moving picture: what the README shows, and anyone's own.

The suspension rides softly for the first half and is switched to handling for the second, so that
the difference can be seen. The picture runs in real time, one frame a control interval.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

import road_envs
from road_envs._atomic_io import atomic_write
from road_envs._extras import optional_import
from road_envs.config import ConfigError

if TYPE_CHECKING:
    from PIL.Image import Image

ANIMATION_FORMATS = {".gif": "GIF", ".webp": "WEBP"}
"""Files that hold moving pictures, by the ending of their names."""

EDGE_TOLERANCE = 40
"""By how much a mixed pixel at an edge may be out of date in a GIF, of 255: less to store."""

SEED = 0

Progress = Callable[[str, float], None]
"""Hears what is being done and the share of all work that is done."""


def animate(
    env_options: Mapping[str, Any],
    seconds: float,
    path: str | Path,
    progress: Progress = lambda text, share: None,
) -> None:
    """Drive up to `seconds` of `RoadRecon-v0` and write the frames to `path` as an endless loop.

    `env_options` are the environment's. The file appears whole or not at all. Raises ConfigError
    on an ending that is not in FORMATS, on less than two frames, and on what the environment
    refuses.
    """
    path = Path(path)
    if path.suffix.lower() not in ANIMATION_FORMATS:
        raise ConfigError(f"{path}: the name must end in {' or '.join(ANIMATION_FORMATS)}")
    env = gymnasium.make(road_envs.ID, **{**env_options, "render_mode": "rgb_array"})
    rate = env.metadata["render_fps"]
    total = round(seconds * rate)
    if total < 2:
        raise ConfigError(f"a moving picture needs at least {2 / rate:g} s, got {seconds:g} s")
    _save(_drive(env, total, progress), path, rate)
    progress("done", 1.0)


def _drive(env: gymnasium.Env, total: int, progress: Progress) -> Iterator[np.ndarray]:
    """Up to `total` frames of an episode: ride, and from the middle on handling."""
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
    """Frames in the renderer's own colours; at edges, pixels of the last one that still will do."""
    with optional_import("a picture"):
        from PIL import Image

    from road_envs.rendering.style import palette

    colours = Image.new("P", (1, 1))
    colours.putpalette(palette())
    values = np.array(palette(), dtype=np.int16).reshape(-1, 3)
    shown = None
    for frame in frames:
        nearest = np.asarray(
            Image.fromarray(frame).quantize(palette=colours, dither=Image.Dither.NONE)
        )
        if shown is None:
            shown = nearest
        at_edge = (frame != values[nearest]).any(axis=2)
        off = np.abs(frame - values[shown]).max(axis=2)
        shown = np.where(at_edge & (off <= EDGE_TOLERANCE), shown, nearest)
        image = Image.fromarray(shown)
        image.putpalette(palette())
        yield image
