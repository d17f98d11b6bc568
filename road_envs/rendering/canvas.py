"""Drawing canvas over Pillow with anti-aliased shapes; coordinates are pixels of the frame."""

import functools
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled

try:
    from PIL import Image, ImageDraw, ImageFont
except ImportError as error:
    raise DependencyNotInstalled("run `pip install 'road-envs[render]'`") from error

SMOOTHING = 3  # supersampling factor of shapes; text is drawn at the final resolution


@functools.cache
def _font(size: int, bold: bool) -> ImageFont.FreeTypeFont:
    """Return DejaVu Sans as shipped with matplotlib; its digits have equal widths."""
    import matplotlib

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", name), size)


class Canvas:
    """Canvas of one panel, `width` x `height` pixels; y increases downwards from the top."""

    def __init__(self, width: int, height: int, fill: str):
        self.width, self.height = width, height
        self._image = Image.new("RGB", (SMOOTHING * width, SMOOTHING * height), fill)
        self._draw = ImageDraw.Draw(self._image)
        self._words: list[tuple[Any, ...]] = []  # place, text, colour, font and anchor of each

    def polygon(self, points: np.ndarray, fill: str, outline: str | None = None) -> None:
        self._draw.polygon(_large(points), fill=fill, outline=outline, width=SMOOTHING)

    def line(self, points: np.ndarray, fill: str, width: float = 1.0) -> None:
        self._draw.line(_large(points), fill=fill, width=round(SMOOTHING * width))

    def box(self, x_0: float, y_0: float, x_1: float, y_1: float, fill: str) -> None:
        self.polygon(np.array([[x_0, y_0], [x_1, y_0], [x_1, y_1], [x_0, y_1]]), fill)

    def disc(self, x: float, y: float, radius: float, fill: str) -> None:
        centre, r = SMOOTHING * np.array([x, y]), SMOOTHING * radius
        self._draw.ellipse([*(centre - r), *(centre + r)], fill=fill)

    def text(
        self,
        x: float,
        y: float,
        words: str,
        fill: str,
        size: int = 12,
        anchor: str = "ls",
        bold: bool = False,
    ) -> None:
        """Write `words` on top of all shapes; `anchor` as in Pillow (ls: left end of baseline)."""
        self._words.append(((x, y), words, fill, _font(size, bold), anchor))

    def pixels(self) -> np.ndarray:
        """Return the finished image (height, width, 3), uint8."""
        image = self._image.reduce(SMOOTHING)
        draw = ImageDraw.Draw(image)
        for words in self._words:
            draw.text(*words)
        return np.asarray(image)


def _large(points: np.ndarray) -> list[float]:
    return (SMOOTHING * np.asarray(points, dtype=float)).ravel().tolist()
