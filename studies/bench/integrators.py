"""Test problem of `bench` and of the work-precision study, for our and other integrators.

The drive is on a class-D road, or another one, at 15 m/s in ride mode; the output is the
acceleration of the body every millisecond. All peers except Octave call the compiled right-hand
side of this project, and the implicit ones of SciPy and SUNDIALS its analytic Jacobian, so they
differ in the method and in the language of the loop. The right-hand side for Octave is vectorised
Octave code.
"""

import math
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.io import loadmat, savemat

from road_envs.roads import load_road, with_length
from road_envs.roads.surface import PAD, Surface
from road_envs.simulation.drive import DriveSimulator
from road_envs.simulation.rosenbrock import sample_road
from road_envs.vehicle.equations import N_DOF, build_plant, extension, wheel_height
from road_envs.vehicle.linear_model import jacobian
from road_envs.vehicle.parameters import GRAVITY, load_vehicle
from road_envs.vehicle.suspension import E_0, E_STEP, V_0, V_STEP, VALVE_OPEN, encode_command
from studies.bench.adaptive_drive import MAX_STEP, integrate_adaptive, state_rate

CAR, SPEED, MODE = "land_rover_defender_110", 15.0, "ride"
OUTPUT_STEP = 0.001
"""Step [s] between the output accelerations."""

EXPLICIT_METHODS = ("RK45", "DOP853")
SCRIPT = Path(__file__).parent / "octave" / "drive.m"
OCTAVE_TIMEOUT = 600.0
"""Time limit [s] of a run of Octave."""


class PeerError(RuntimeError):
    """A peer integrator is not installed, or it failed; the message names it and the cause."""


def _atol_of(rtol: float) -> float:
    """Return the absolute tolerance for a relative one, the same for every method."""
    return 1e-3 * rtol


class IntegrationProblem:
    """A drive of `duration` [s]; every solver returns accelerations (N, 3) [m/s²] at times `t`.

    `surface` replaces the class-D road. `max_step` [s] limits the steps of adaptive solvers.
    """

    def __init__(self, duration: float, surface: Surface | None = None, max_step: float = math.inf):
        self.car = load_vehicle(CAR)
        self.plant = build_plant(self.car)
        if surface is None:
            road = with_length(load_road("iso_d"), SPEED * duration + 20.0)
            surface = road.realise(np.random.default_rng(1))
        self.surface, self.max_step = surface, max_step
        self.t = OUTPUT_STEP * np.arange(round(duration / OUTPUT_STEP))

    def new_drive(self, step: float = OUTPUT_STEP) -> DriveSimulator:
        """Return the drive at its start, for integration in steps of `step` [s]."""
        return DriveSimulator(self.plant, self.car, self.surface, SPEED, MODE, step)

    def fixed_step(self, step: float) -> np.ndarray:
        """Integrate with this project's fixed step [s], a divisor of OUTPUT_STEP."""
        drive, ratio = self.new_drive(step), round(OUTPUT_STEP / step)
        motion = drive.advance(np.full(self.t.size * ratio, encode_command(MODE), dtype=np.uint8))
        return motion.acceleration[::ratio, :3]

    def adaptive(self, rtol: float) -> np.ndarray:
        """Integrate with this project's adaptive Rosenbrock pair."""
        solution = integrate_adaptive(
            self.new_drive(), self.t, rtol, _atol_of(rtol), min(self.max_step, MAX_STEP)
        )
        return solution.trajectory.acceleration[:, :3]

    def scipy(self, method: str, rtol: float) -> np.ndarray:
        """Integrate with a method of `scipy.integrate.solve_ivp`."""
        rate, jac = self._rate_and_jacobian()
        options = {} if method in EXPLICIT_METHODS else {"jac": jac}
        solution = solve_ivp(
            lambda t, y: rate(t, y, np.empty(2 * N_DOF)),
            (0.0, float(self.t[-1])),
            self.new_drive().state,
            method=method,
            t_eval=self.t,
            rtol=rtol,
            atol=_atol_of(rtol),
            max_step=self.max_step,
            **options,
        )
        return self._accelerations(solution.y.T)

    def cvode(self, rtol: float) -> np.ndarray:
        """Integrate with BDF of SUNDIALS CVODE. Raises PeerError without scikit-sundae."""
        try:
            from sksundae.cvode import CVODE
        except ImportError:
            raise PeerError(
                "scikit-sundae is not installed (pip install road-envs[peers])"
            ) from None
        rate, jac = self._rate_and_jacobian()

        def fill(t: float, y: np.ndarray, rates: np.ndarray, J: np.ndarray) -> None:
            J[:] = jac(t, y)

        max_step = self.max_step if math.isfinite(self.max_step) else 0.0  # 0: unlimited
        options = {"rtol": rtol, "atol": _atol_of(rtol), "max_step": max_step}
        solver = CVODE(rate, jacfn=fill, max_num_steps=10**6, **options)
        return self._accelerations(solver.solve(self.t, self.new_drive().state).y)

    def octave(self, rtol: float) -> tuple[np.ndarray, float]:
        """Integrate with ode23s of Octave; also return the time [s] without start-up.

        Raises PeerError if Octave is missing, fails or exceeds OCTAVE_TIMEOUT.
        """
        program = shutil.which("octave-cli") or shutil.which("octave")
        if program is None:
            raise PeerError("Octave is not installed")
        with tempfile.TemporaryDirectory() as folder:
            problem, answer = Path(folder, "problem.mat"), Path(folder, "answer.mat")
            savemat(problem, self._octave_inputs() | {"rtol": rtol, "atol": _atol_of(rtol)})
            try:
                subprocess.run(
                    [program, "--norc", "--quiet", SCRIPT, problem, answer],
                    check=True, capture_output=True, text=True, timeout=OCTAVE_TIMEOUT,
                )  # fmt: skip
            except subprocess.TimeoutExpired:
                raise PeerError(
                    f"Octave exceeded the time limit of {OCTAVE_TIMEOUT:.0f} s"
                ) from None
            except subprocess.CalledProcessError as error:
                raise PeerError(f"Octave failed: {' '.join(error.stderr.split())}") from None
            solution = loadmat(answer)
        return self._accelerations(solution["y"]), float(solution["seconds"].item())

    def _rate_and_jacobian(self) -> tuple[Callable[..., np.ndarray], Callable[..., np.ndarray]]:
        """Return the right-hand side, which fills its third argument, and the Jacobian (14, 14)."""
        drive, surface, road = self.new_drive(), self.surface.buffers, np.empty(8)
        vehicle = self.plant.buffers(drive.strut_state)

        def rate(t: float, y: np.ndarray, out: np.ndarray) -> np.ndarray:
            s = drive.start + SPEED * t
            state_rate(vehicle, surface, s, SPEED, y, out)
            return out

        def jac(t: float, y: np.ndarray) -> np.ndarray:
            sample_road(vehicle.constants[0], surface, drive.start + SPEED * t, SPEED, road)
            return jacobian(self.plant, drive.strut_state, y, road[:4], road[4:])

        return rate, jac

    def _accelerations(self, states: np.ndarray) -> np.ndarray:
        if len(states) != self.t.size:
            raise PeerError(f"the solver stopped after {len(states)} of {self.t.size} ms")
        rate, _ = self._rate_and_jacobian()
        rates, y = np.empty((self.t.size, 2 * N_DOF)), np.ascontiguousarray(states)
        for k, t in enumerate(self.t):
            rate(t, y[k], rates[k])
        return rates[:, N_DOF : N_DOF + 3]

    def _octave_inputs(self) -> dict[str, Any]:
        """Return the inputs of drive.m.

        Strut forces act along the rows of `B` (4, 7), tyre forces along those of `G` (4, 7).
        """
        drive, p = self.new_drive(), self.plant.constants[0]
        unit, wheels, axle = np.eye(N_DOF), range(4), np.repeat([0, 1], 2)
        names = ("n_p", "x_1", "column_min")
        # gravity acts on the heights of body and axles
        gravity = np.where(np.isin(np.arange(N_DOF), (0, 3, 5)), GRAVITY, 0.0)
        columns = {
            "share": 1.0 - drive.strut_state[:, VALVE_OPEN] * p["r_2"],
            "side": np.array([1.0, 2.0, 1.0, 2.0]),
            "behind": (p["x"][0] - p["x"])[axle],
            "y_0": drive.state, "M": p["M"], "g": gravity,
            **{name: p[name] for name in ("p_A", "k_t", "c_t")},
            "delta": p["delta"][axle],
        }  # fmt: skip
        return {
            **{name: float(p[name]) for name in names},
            **{name: values[:, None] for name, values in columns.items()},
            "B": np.array([[extension(p, q, w) for q in unit] for w in wheels]),
            "G": np.array([[wheel_height(p, q, w) for q in unit] for w in wheels]),
            "damper": self.plant.velocity[0, 1:-1], "V_0": V_0, "dV": V_STEP,
            "stops_front": self.plant.displacement[0, 1:-1],
            "stops_rear": self.plant.displacement[1, 1:-1], "E_0": E_0, "dE": E_STEP,
            "padded": self.surface.padded, "pad": float(PAD), "start": self.surface.start,
            "ds": self.surface.ds, "s_0": drive.start, "v": SPEED, "t": self.t,
            "max_step": min(self.max_step, float(self.t[-1])),
        }  # fmt: skip


def relative_error(a: np.ndarray, truth: np.ndarray) -> float:
    """Return the RMS difference over the RMS of the truth [-]."""
    return math.sqrt(float(np.mean((a - truth) ** 2) / np.mean(truth**2)))
