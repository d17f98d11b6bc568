"""Commands `roads list`, `roads plot`, `roads export`, `export` of a report's road, and `iri`."""

from pathlib import Path
from typing import Annotated, Any

from leaderboard.commands import PICTURES, check_output_path, make_table
from leaderboard.commands.options import Length, Seed, argument, option
from leaderboard.commands.output import Output
from leaderboard.drive_report.export import read_heights
from leaderboard.report import plots
from road_envs.core import config
from road_envs.core.config import ConfigError
from road_envs.records import roughness
from road_envs.roads import Surface, realise_road
from road_envs.roads.formats.write import WRITERS, write, write_crg

_Which = Annotated[str, argument("Shipped name, YAML path or surface file.")]


def list_roads() -> Output:
    """List the shipped roads, each realised with seed 1."""
    rows: list[dict[str, Any]] = []
    for name in config.names("roads"):
        surface = realise_road(name, 1)
        n, G_d = roughness.smooth_psd(*roughness.displacement_psd(surface.z, surface.ds))
        letters = {
            roughness.roughness_class(roughness.fit_line(n, G, w=2.0)[0]) if G.max() > 0 else "-"
            for G in G_d
        }
        rows.append({
            "road": name, "length_m": surface.length,
            "rms_mm": [1000.0 * float(z.std()) for z in surface.z],
            "iri_mm_per_m": [float(roughness.iri(z, surface.ds)) for z in surface.z],
            "class": "".join(sorted(letters)), "notes": list(surface.notes),
        })  # fmt: skip
    pair, keys = "{:.1f}, {:.1f}".format, ("rms_mm", "iri_mm_per_m")
    cells = [
        (x["road"], f"{x['length_m']:.1f}", *(pair(*x[key]) for key in keys), x["class"])
        for x in rows
    ]
    heads = ("road", "length [m]", "RMS left, right [mm]", "IRI left, right [mm/m]", "class")
    return Output(facts=rows, shows=[make_table(heads, cells, texts=("class",))])


def plot_road(
    road: _Which,
    out: Annotated[Path, option("Picture to write (.png, .svg or .pdf).")],
    length: Length = None,
    seed: Seed = 1,
) -> Output:
    """Plot both wheel paths of a road, and their PSD over the ISO 8608 classes."""
    check_output_path(out, *PICTURES)
    plots.draw_road(realise_road(road, seed, length), out)
    return Output(facts={"written": str(out)})


def export(
    road: _Which,
    out: Annotated[Path, option("File to write (.csv, .parquet, .crg or .erd).")],
    length: Length = None,
    seed: Seed = 1,
    form: Annotated[str | None, option("Format of a .crg file: KDBI, KRBI, LDFI or LRFI.")] = None,
) -> Output:
    """Write both wheel paths of a road to a file that can be read back as a road."""
    check_output_path(out, *WRITERS)
    if form and out.suffix.lower() != ".crg":
        raise ConfigError(f"{out}: --form is for .crg files only; leave it out")
    return _written(realise_road(road, seed, length), out, form)


def export_heights(
    heights: Annotated[Path, argument("NAME_heights.parquet of a report.")],
    out: Annotated[Path, option("Road: .erd for ProVAL, .crg for simulators, .csv.")],
) -> Output:
    """Write the road that a report found as a surface for other programs.

    The own vehicle over it moves as in the drive: `simulate --road` takes it, too.
    """
    check_output_path(out, *WRITERS)
    return _written(read_heights(heights), out)


def iri(
    *,
    profile: Annotated[Path, argument("Profile or surface: .csv, .erd, .crg, ...")],
    segment: Annotated[float, option("Length of a segment in m.", min=1.0)] = 100.0,
) -> Output:
    """Print the International Roughness Index of a profile by segment (ASTM E1926).

    Left and right are those of the wheel paths, mean is their mean (MRI), and the half-car index
    (HRI) that of the mean profile, in mm/m.
    """
    if not profile.is_file():
        raise ConfigError(f"{profile}: no such file; give a profile or a surface, such as road.erd")
    surface = realise_road(profile, 0)
    rows = roughness.profile_indices(surface.z, surface.ds, segment)
    whole = roughness.profile_indices(surface.z, surface.ds, float("inf"))[0]
    text = "{begin_m:.1f} {end_m:.1f} {left:.2f} {right:.2f} {mean:.2f} {half_car:.2f}".format
    cells = [
        (*text(**row).split(), f"{roughness.IN_PER_MI * row['mean']:.0f}") for row in (*rows, whole)
    ]
    facts = {"file": str(profile), "spacing_m": surface.ds, "segments": rows, "whole": whole,
             "notes": list(surface.notes)}  # fmt: skip
    heads = ("from [m]", "to [m]", "left", "right", "mean", "half-car (HRI)", "mean [in/mi]")
    told = "IRI in mm/m; the last line is that of the whole profile"
    return Output(facts=facts, shows=[make_table(heads, cells), told])


def _written(surface: Surface, out: Path, form: str | None = None) -> Output:
    write_crg(surface, out, form) if form else write(surface, out)
    return Output(facts={"written": str(out), "length_m": surface.length, "spacing_m": surface.ds})
