"""Commands `policies` and `train-policy`: suspension-switching policies."""

import contextlib
import dataclasses
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

from leaderboard import commands
from leaderboard.commands.options import Json, LimitOptions, option
from leaderboard.entries.entry import NAME
from leaderboard.policies import best_found, comparison
from leaderboard.policies import page as policy_page
from leaderboard.policies.policy_process import POLICY_LIMITS, PolicyProcess
from leaderboard.report.rendering import POLICY_PAGE, write_pending
from leaderboard.sandbox import bubblewrap
from leaderboard.sandbox.limits import Isolation, Limits
from road_envs.core.atomic_io import atomic_write, write_text
from road_envs.core.config import ConfigError, validate_choice
from road_envs.policies import (
    FILE_SUFFIXES,
    REGISTRY,
    create,
    make_policy,
    names,
    runs_foreign_code,
)
from road_envs.policies.fixed import FixedPair
from road_envs.policies.network_policy import SB3_SUFFIX, NetworkPolicy
from road_envs.policies.policy_iteration import IterationConfig, iterate
from road_envs.vehicle.suspension import MODES

POLICY_OPTIONS = LimitOptions(time_limit=POLICY_LIMITS.seconds, memory_limit=POLICY_LIMITS.memory)
_QUICK_DRIVES = 2  # public drives of `--quick`, each to both sides
_PUBLIC = (
    "These drives are public: {} may have been trained on them, or play back what was found for "
    "them beforehand, and a place then says nothing. Compare policies of others on drives that a "
    "text seals which their authors do not know (--seal)."
)
_WITHOUT_STATISTICS = (
    "{}: the file holds no statistics of VecNormalize and no masks of actions; the network gets "
    "the features as they are, may choose each action, and is asked for one in each control "
    "interval, whatever its action_repeat in training."
)
RIVALS = ("rrms", "rrms_lateral", "lateral", "mpc")  # laws to compare a newly trained policy with


def policies(
    *,
    policy: Annotated[
        list[str] | None,
        option(
            "Policy: a name of `road-recon list policies`, module:Class, or a file from "
            "`train-policy` (.npz) or Stable-Baselines3 (.zip); may be given again. Default: all "
            "of this package, all constant pairs, and installed ones where they can be isolated."
        ),
    ] = None,
    drives: Annotated[
        int, option("Public drives, each to both sides.", min=2)
    ] = comparison.PUBLIC_DRIVES,
    sweeps: Annotated[
        int, option("Sweeps of the search for the best switching; 0: none.", min=0)
    ] = best_found.SWEEPS,
    seal: Annotated[
        str | None,
        option("Secret text, of 16 characters or more, of sealed drives, instead of public ones."),
    ] = None,
    reference: Annotated[str, option("Policy that differences refer to.")] = comparison.REFERENCE,
    quick: Annotated[bool, option("Two drives, without the search: seconds.", "--quick")] = False,
    out: Annotated[Path | None, option("Folder for the table and the page.")] = None,
    limits: LimitOptions = POLICY_OPTIONS,
    json: Json = False,
) -> None:
    """Compare policies by comfort and safety on the drives of RoadRecon/Safe4S4-v1."""
    commands.check_output_folder(out)
    if quick:
        drives, sweeps = _QUICK_DRIVES, 0
    chosen = policy if policy is None or reference in policy else [*policy, reference]
    entries, base = _entries(chosen, limits.parse()), _row_name(reference)
    if policy is None:
        entries |= {f"{f}/{r}": FixedPair(front=f, rear=r) for r in MODES for f in MODES}  # type: ignore[arg-type]
        if base not in entries:
            entries |= _entries([reference], limits.parse())
    if out:
        write_pending(out / POLICY_PAGE, "Switching policies", f"policies --out {out}")
    with contextlib.ExitStack() as processes, commands.progress_bar() as progress:
        for entry in entries.values():
            if isinstance(entry, PolicyProcess):
                processes.enter_context(entry)
        setup = comparison.public_drives(drives, seal)
        setup.threads = min(2, os.cpu_count() or 1)
        found = comparison.compare(entries, setup, base, sweeps=sweeps, progress=progress)
    found.data["notes"] = _notes(entries, chosen or [reference], seal)
    lines = [*comparison.table_lines(found.data), *found.data["notes"]]
    if out:
        write_text(out / "benchmark.json", commands.to_json(found.data))
        write_text(out / "benchmark.txt", "\n".join(lines) + "\n")
        page = policy_page.write_page(found.data, policy_page.timelines(found), out)
        commands.notices.print(f"page: {page}")
    if json:
        commands.print_json(found.data)
    for line in [] if json else lines:
        commands.console.print(line, soft_wrap=True, highlight=False)
    if failed := [row["policy"] for row in found.data["rows"] if row["failure"]]:
        raise ConfigError(f"failed policies: {', '.join(failed)}; the other results are valid")


def _notes(entries: Iterable[str], references: Iterable[str], seal: str | None) -> list[str]:
    """Return what a reader has to know of the policies of others among the names of `entries`."""
    others = [name for name in entries if name not in REGISTRY and NAME.fullmatch(name)]
    public = [_PUBLIC.format(", ".join(others))] if others and seal is None else []
    networks = (_row_name(x) for x in references if x.endswith(SB3_SUFFIX))
    return public + [_WITHOUT_STATISTICS.format(name) for name in networks]


def policy_isolation(reference: str, isolation: str) -> Isolation:
    """Return how a policy is run, of this package always in a process without bubblewrap.

    Raises ConfigError for one that may not be run by the option `isolation`, or is none.
    """
    commands.find_from_here([reference])
    if ":" not in reference and not reference.endswith(FILE_SUFFIXES):
        validate_choice("policy", reference, names())
    if isolation == "process" or not runs_foreign_code(reference):
        return "process"
    if not bubblewrap.is_used(isolation):
        raise ConfigError(
            f"the policy {reference} is not part of this package, and {bubblewrap.obstacle()}: "
            "install it, or give --isolation process if you trust its code with your rights"
        )
    return "bubblewrap"


def _entries(references: list[str] | None, limits: Limits) -> dict[str, Any]:
    """Return the policies by name, those of other packages in processes. Raises ConfigError."""
    are_chosen = references is not None
    if references is None:
        may_be_foreign = limits.isolation == "process" or bubblewrap.is_used(limits.isolation)
        known = names() if may_be_foreign else REGISTRY
        # constant pairs of this package have rows of their own
        references = [n for n in known if n not in REGISTRY or not n.startswith("fixed")]
    entries: dict[str, Any] = {}
    for reference in references:
        try:
            name = _row_name(reference, are_chosen)
        except ConfigError as error:
            if are_chosen:
                raise
            commands.notices.print(f"left out: {error}", soft_wrap=True)  # others have their rows
            continue
        own = dataclasses.replace(limits, isolation=policy_isolation(reference, limits.isolation))
        if name in entries:
            raise ConfigError(f"two policies have the name {name!r}: give each of them once")
        is_foreign = runs_foreign_code(reference)
        entries[name] = (
            PolicyProcess(reference, limits=own) if is_foreign else make_policy(reference)
        )
    return entries


def _row_name(reference: str, may_be_path: bool = True) -> str:
    """Return the name of the row of a policy. Raises ConfigError for one that is another's.

    A `reference` that is no name may be that of a file or a class, if it `may_be_path`.
    """
    name = reference
    if may_be_path:
        is_file = reference.endswith(FILE_SUFFIXES)
        name = Path(reference).stem if is_file else reference.rpartition(":")[2].rpartition(".")[2]
    is_taken = name.lower().replace("-", "_") in (*REGISTRY, "best_found")
    if reference not in REGISTRY and (not NAME.fullmatch(name) or is_taken):
        raise ConfigError(
            f"the row of {reference!a} would have the name {name!a}: it must be a letter and at "
            "most 39 letters, digits, - or _, and not that of a policy of this package; rename it"
        )
    return name


def train_policy(
    *,
    out: Annotated[Path, option("File for the best policy (.npz).")],
    seed: Annotated[int, option("Training seed.", min=0)] = 1,
    steps: Annotated[int, option("Rounds.", min=1)] = IterationConfig.steps,
) -> None:
    """Train a policy on training drives, and compare it with laws on public ones."""
    commands.check_output_path(out, ".npz")
    with commands.progress_bar() as progress:
        network, curve = iterate(IterationConfig(steps=steps), seed, progress)
        name, laws = f"seed {seed}", {law: create(law) for law in RIVALS}
        entries: dict[str, Any] = {name: NetworkPolicy.from_network(network)} | laws
        found = comparison.compare(entries, comparison.public_drives(), sweeps=0).data
    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(out) as partial:
        partial.write_bytes(network.to_bytes())
    write_text(out.with_suffix(".json"), commands.to_json(found | {"curve": curve}))
    scores = " ".join(f"{score:.3f}" for _, score in curve)
    for line in [f"{name}, score by round: {scores}", "", *comparison.table_lines(found)]:
        commands.console.print(line, soft_wrap=True, highlight=False)
