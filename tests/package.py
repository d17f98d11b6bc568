"""Build wheel and sdist, install each into an empty environment, and try it there: `make package`.

The environments get the extra `board`, without torch: what a first user installs. Each of them
simulates a drive, estimates its road, writes a report of it and evaluates two estimators on a
task of one short road, from a folder outside the checkout.
"""

import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]


WHERE = "import road_envs, sys; print(road_envs.__file__.startswith(sys.prefix))"

ENVIRONMENT = """
import gymnasium, road_envs
env = gymnasium.make("RoadRecon-v0", road="belgian", control="axle")
observation, info = env.reset(seed=1)
assert env.observation_space.contains(observation)
assert env.step(2)[1] < 0.0
"""


def run(*words: str | Path, cwd: Path, timeout: float = 900.0) -> str:
    """Run a command without the checkout on its path; return its output, or end with it."""
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        [str(word) for word in words],
        cwd=cwd, env=clean, capture_output=True, text=True, timeout=timeout,
    )  # fmt: skip
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(map(str, words))}\n{done.stdout}{done.stderr}")
    return done.stdout


def try_out(distribution: Path, folder: Path) -> None:
    """Install a distribution into an empty environment inside `folder`, and use it."""
    folder.mkdir()
    venv.create(folder / "environment", with_pip=True)
    programs = folder / "environment/bin"
    run(
        programs / "python", "-m", "pip", "install", "--quiet", "--constraint",
        ROOT / "constraints.txt", f"road-envs[board] @ {distribution.as_uri()}", cwd=folder,
    )  # fmt: skip
    recon = programs / "road-recon"
    assert run(programs / "python", "-c", WHERE, cwd=folder).strip() == "True"
    run(programs / "python", "-c", ENVIRONMENT, cwd=folder)
    drive = ("--road", "iso_c", "--length", "60", "--speed-kmh", "36", "--out", "drive.csv")
    run(recon, "simulate", *drive, "--truth", "truth.csv", cwd=folder)
    run(recon, "estimate", "wiener", "drive.csv", "--truth", "truth.csv", cwd=folder)
    run(recon, "report", "drive.csv", "--out", "report", cwd=folder)
    names = ("--estimator", "flat", "--estimator", "fir_ridge")
    limits = ("--seeds", "1", "--workers", "1", "--length", "60")
    run(recon, "leaderboard", "--task", "paper_8", *names, *limits, "--out", "board", cwd=folder)
    for page in ("report/index.html", "board/index.html"):
        assert (folder / page).is_file(), page


def main(out: Path = ROOT / "dist") -> None:
    """Build both distributions into `out` and try them, one after the other."""
    run(sys.executable, "-m", "build", "--outdir", out, ROOT, cwd=ROOT)
    version = run(sys.executable, "-c", "import road_envs; print(road_envs.__version__)", cwd=ROOT)
    distributions = sorted(out.glob(f"road_envs-{version.strip()}*"))
    assert len(distributions) == 2, distributions
    with tempfile.TemporaryDirectory() as folder:
        for distribution in distributions:
            try_out(distribution, Path(folder, distribution.name))
            size = distribution.stat().st_size / 1e6
            print(f"{distribution.name}: {size:.1f} MB, installs and runs")


if __name__ == "__main__":
    main()
