"""A drive as a moving picture: what the README shows, and anyone's own.

The suspension rides softly for the first half and is switched to handling for the second, so that
the difference can be seen. The picture runs in real time, one frame a control interval.
"""

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import road_envs
from road_envs.config import ConfigError

SUFFIXES = (".gif", ".png", ".webp")
"""Kinds of file that hold moving pictures; .png is an animated PNG."""

SEED = 0


def animate(
    env_options: Mapping[str, Any],
    seconds: float,
    path: str | os.PathLike,
    progress: Callable[[str, float], None] = lambda text, share: None,
    width: int | None = None,
) -> None:
    """Drive up to `seconds` of `RoadRecon-v0` and write the frames to `path` as an endless loop.

    `env_options` are the environment's; `width` [pixels] makes the picture smaller. The file
    appears whole or not at all. `progress` hears what is done and the share done, 0 to 1. Raises
    ConfigError on an ending that is not in SUFFIXES and on what the environment refuses.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{path}: the name must end in {', '.join(SUFFIXES)}")
    env = gymnasium.make(road_envs.ID, **{**env_options, "render_mode": "rgb_array"})
    rate = env.metadata["render_fps"]
    total = round(seconds * rate)
    if total < 2:
        raise ConfigError(f"an animation needs two frames, {2 / rate} s; got {seconds} s")
    _write(frames(env, total, progress), path, 1000.0 / rate, width)
    progress("done", 1.0)


def frames(
    env: gymnasium.Env, total: int, progress: Callable[[str, float], None]
) -> Iterator[np.ndarray]:
    """Up to `total` frames of an episode: ride, and from the middle on handling."""
    env.reset(seed=SEED)
    handling = int(env.action_space.n) - 1  # type: ignore[attr-defined]
    over = False
    for k in range(total):
        if over:
            break
        progress("driving", k / total)
        yield env.render()  # type: ignore[misc]
        *_, terminated, truncated, _ = env.step(handling if 2 * k >= total else 0)
        over = terminated or truncated


def _write(pictures: Iterator[np.ndarray], path: Path, duration: float, width: int | None) -> None:
    from PIL import Image

    images = (_smaller(Image.fromarray(picture), width) for picture in pictures)
    options: dict[str, Any] = {"save_all": True, "duration": duration, "loop": 0}
    if path.suffix.lower() == ".gif":
        images, options = _with_one_palette(images), {**options, "optimize": True}
    first = next(images)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, partial = tempfile.mkstemp(prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            first.save(file, format=Image.registered_extensions()[path.suffix.lower()], append_images=images, **options)
        os.chmod(partial, 0o644)
        os.replace(partial, path)
    except BaseException:
        os.unlink(partial)
        raise


def _smaller(image, width: int | None):
    """The image at another width, if one is given."""
    if width is None:
        return image
    height = round(image.height * width / image.width)
    return image.resize((width, height))


def _with_one_palette(images):
    """The images in the renderer's own colours: what stands still then costs a GIF nothing."""
    from PIL import Image

    from road_envs.rendering.style import palette

    colours = Image.new("P", (1, 1))
    colours.putpalette(palette())
    for image in images:
        yield image.quantize(palette=colours, dither=Image.Dither.NONE)
