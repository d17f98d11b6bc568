"""Definition of a metric: a function of one scored estimate, with its format and its explanation.

A metric is declared beside its function, which returns NaN where it is not defined:

    @metric("in-band NRMSE", digits=3, head="NRMSE", boards=("new_road",))
    def nrmse(scored: ScoredEstimate) -> float:
        \"\"\"RMS error over RMS truth in the scored band.\"\"\"
        return ...

Its key is the name of the function, its explanation on pages the docstring. A function of several
metrics returns them in the order of their forms (`metrics`, as in `level`). `registry` collects the
metrics of every module that it lists.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from leaderboard.metrics import UNDEFINED, heights
from leaderboard.metrics.alignment import align_locally
from road_envs.records.record import Estimate, Profile
from road_envs.records.roughness import displacement_psd

PERCENT: Any = {"unit": "%", "factor": 100.0, "digits": 0}  # format of a share
_HEIGHT_LIMIT = 1e6  # [m] to which estimates are clipped: an absurd one still has a score


class ScoredEstimate:
    """Truth and estimate of one drive, and what several metrics need of them, computed once.

    `y` and `a` (2, M) [m] are the true and the estimated heights, `ds` [m] apart at `v` [m/s], with
    the deviation `std` (2, M) [m] of the estimate, if it has one. `bumps`: obstacles are scored;
    `bound` is that on the NRMSE of this drive or NaN; `wandering`: so are locally aligned heights.
    """

    def __init__(
        self,
        truth: Profile,
        estimate: Estimate,
        v: float,
        *,
        bumps: bool,
        bound: float = np.nan,
        wandering: bool = False,
    ) -> None:
        self.y, self.a = truth.z, np.clip(estimate.z, -_HEIGHT_LIMIT, _HEIGHT_LIMIT)
        self.std = None if estimate.z_std is None else np.minimum(estimate.z_std, _HEIGHT_LIMIT)
        self.ds, self.v, self.bound = truth.ds, v, bound
        self.bumps, self.wandering = bumps, wandering
        self._shared: dict[Callable[..., Any], Any] = {}

    @property
    def band(self) -> heights.Band:
        """The scored band [cycles/m] at the speed of the drive."""
        return heights.scored_band(self.v)

    @cached_property
    def in_band(self) -> tuple[np.ndarray, np.ndarray]:
        """Truth and estimate, each (2, K) [m], inside the scored band."""
        return heights.in_band(self.y, self.a, self.ds, self.band)

    @cached_property
    def aligned(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Truth, estimate (2, K) [m] inside the scored band after local alignment, and the standard
        deviation (2, L) [m] about them, if the estimate has one.
        """
        y, a, std = align_locally(self.y, self.a, self.std, self.ds, self.v)
        return *heights.in_band(y, a, self.ds, self.band), std

    @cached_property
    def densities(self) -> tuple[np.ndarray, np.ndarray]:
        """Frequencies (F,) [cycles/m], and densities (3, 2, F) [m³] of truth, estimate, error."""
        n, G = displacement_psd(np.stack([self.y, self.a, self.a - self.y]), self.ds)
        return n, G

    def shared(self, function: Callable[["ScoredEstimate"], Any]) -> Any:
        """Return `function(self)`, computed once for all metrics that need it."""
        if function not in self._shared:
            self._shared[function] = function(self)
        return self._shared[function]


@dataclass(frozen=True)
class Metric:
    """A metric: its function, and its format as `factor` times the value with `digits` decimals.

    `label` names it in full, `head` at the top of a table column, `help` explains it in a sentence
    or two. Values are printed in `unit`; `better` tells which ones are good. It is a column on
    request of each of `boards`, beside those that list it themselves; `blank` stands for a value
    that is not defined. Columns that a board derives from scores have no `compute`; `wide` ones are
    shown on request only.
    """

    key: str
    label: str
    unit: str = ""
    factor: float = 1.0
    digits: int = 2
    better: Literal["low", "high", "zero", ""] = "low"
    head: str = ""
    help: str = ""
    boards: tuple[str, ...] = ()
    blank: str = UNDEFINED
    compute: Callable[[ScoredEstimate], float] | None = None
    wide: bool = False

    def format_value(self, value: float | None) -> str:
        """Return the value as text; `blank` if it is missing or not finite."""
        if value is None or not np.isfinite(value):
            return self.blank
        rounded = round(self.factor * value, self.digits) + 0.0  # no minus before a zero
        return f"{rounded:{'+' if self.better == 'zero' else ''}.{self.digits}f}"

    def text(self, value: float | None) -> str:
        """Return the value as text with its unit."""
        return f"{self.format_value(value)} {self.unit}".strip()

    @property
    def heading(self) -> str:
        """The label, with the unit in brackets."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label


def metric(label: str, **form: Any) -> Callable[[Callable[[ScoredEstimate], float]], Metric]:
    """Return a decorator that makes a function a Metric with this format."""

    def declare(function: Callable[[ScoredEstimate], float]) -> Metric:
        explanation = " ".join((function.__doc__ or "").split())
        return Metric(function.__name__, label, help=explanation, compute=function, **form)

    return declare


def metrics(*forms: Metric) -> Callable[[Callable[..., Sequence[float]]], tuple[Metric, ...]]:
    """Return a decorator that makes a function of several scores a Metric for each of `forms`."""

    def declare(function: Callable[..., Sequence[float]]) -> tuple[Metric, ...]:
        def score(k: int) -> Callable[[ScoredEstimate], float]:
            return lambda scored: scored.shared(function)[k]

        return tuple(replace(form, compute=score(k)) for k, form in enumerate(forms))

    return declare
