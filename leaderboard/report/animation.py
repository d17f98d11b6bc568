"""Animation of a drive for the README and for users.

The suspension is in ride mode for the first half and in handling mode for the second, so that the
difference is visible. The animation runs in real time, one frame per control interval.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import road_envs
from road_envs.core.atomic_io import atomic_write
from road_envs.core.config import ConfigError
from road_envs.core.extras import optional_import


def animate(
    env_options: Mapping[str, Any],
    seconds: float,
    path: Path,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> None:
    """Drive up to `seconds` of `RoadRecon-v0` and write the frames to `path`, .gif or .webp, as an
    endless loop. Raises ConfigError for less than two frames, and for invalid `env_options`.
    """
    env = gymnasium.make(road_envs.ID, **{**env_options, "render_mode": "rgb_array"})
    rate = env.metadata["render_fps"]
    total = round(seconds * rate)
    if total < 2:
        raise ConfigError(f"an animation needs at least {2 / rate:g} s, got {seconds:g} s")

    def frames() -> Iterator[np.ndarray]:
        """An episode in ride mode, then from the middle in handling mode."""
        env.reset(seed=0)
        handling = int(env.action_space.n) - 1  # type: ignore[attr-defined]
        for k in range(total):
            progress("driving", k / total)
            yield env.render()  # type: ignore[misc]
            *_, terminated, truncated, _ = env.step(handling if 2 * k >= total else 0)
            if terminated or truncated:
                return

    with optional_import("a picture"):
        from PIL import Image

    kind = path.suffix.upper().removeprefix(".")
    images = _quantized(frames()) if kind == "GIF" else map(Image.fromarray, frames())
    first = next(images)
    options = {"save_all": True, "append_images": images, "duration": 1000.0 / rate, "loop": 0}
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial:
        first.save(partial, kind, optimize=True, **options)
    progress("done", 1.0)


def _quantized(frames: Iterator[np.ndarray]) -> Iterator[Any]:
    """Yield frames in the renderer's palette; edge pixels within 40 of 255 keep the last value."""
    from PIL import Image

    from road_envs.rendering.style import palette

    colours = Image.new("P", (1, 1))
    colours.putpalette(palette())
    values = np.array(palette(), dtype=np.int16).reshape(-1, 3)
    last = None
    for frame in frames:
        indexed = Image.fromarray(frame).quantize(palette=colours, dither=Image.Dither.NONE)
        nearest = np.asarray(indexed)
        if last is None:
            last = nearest
        at_edge = (frame != values[nearest]).any(axis=2)
        off = np.abs(frame - values[last]).max(axis=2)
        last = np.where(at_edge & (off <= 40), last, nearest)
        image = Image.fromarray(last)
        image.putpalette(palette())
        yield image
