"""Conformance checks of a switching policy, one sentence for each check.

    runs           valid actions for every interval of a lane change on a rough road
    actions        the action spaces "vehicle" and "axle"; the policy may refuse them
    observations   without the groups "planar" and "struts"; the policy may refuse to
    repeat         driven twice: the same actions
    reset          a policy that has driven before acts like a new one
    vehicles       a vehicle driven alone is commanded as among others
    sensors        a dead and a saturated accelerometer
    time, memory   the limits of a comparison

The result of a check that does not apply or that is refused is neither passed nor failed. The
policy runs in a process of its own (`policy_process`).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from leaderboard.conformance.probes import CheckResult
from leaderboard.policies.comparison import PUBLIC_DRIVES
from leaderboard.policies.policy_process import POLICY_LIMITS, PolicyProcess
from leaderboard.sandbox.limits import Limits
from road_envs.core.config import ConfigError
from road_envs.envs.options import EnvSetup
from road_envs.envs.safe4s4 import SafeOptions
from road_envs.policies import create
from road_envs.policies.api import PolicyContext, PolicyError, validate_actions
from road_envs.policies.rollout import POLICY_SEED, roll_out

OPTIONS: Mapping[str, Any] = {
    "road": "iso_d",
    "speed_kmh": 54.0,
    "length": 60.0,
    "control": "states",
    "control_rate": 50.0,
    "manoeuvre": {"kind": "lane_change", "offset": 2.0},
    "observe": ["accelerations", "planar", "struts"],
}
_Verdict = tuple[bool | None, str]  # whether a check is passed, and a sentence
SEEDS = range(4)  # seeds of the roads, one for each vehicle
_REFUSALS = ("ConfigError", "ValueError", "NotImplementedError")
"""Errors by which a policy may refuse an action space or an observation on purpose."""


def check_policy(
    reference: str, settings: Mapping[str, Any] | None = None, limits: Limits = POLICY_LIMITS
) -> list[CheckResult]:
    """Run all checks of the policy `reference`, as `make_policy` takes it; the first alone if the
    policy does not run.
    """
    with PolicyProcess(reference, settings, limits) as policy:
        try:
            first = roll_out(policy, dict(OPTIONS), SEEDS)
        except (PolicyError, ConfigError) as error:
            return [CheckResult("runs", False, str(error))]
        seconds = list(policy.act_seconds)
        fixed = (create(name) for name in ("fixed_ride", "fixed_handling"))
        ride, handling = (roll_out(x, dict(OPTIONS), SEEDS).returns.mean() for x in fixed)
        spaces = {x: _short(policy, control=x) for x in ("vehicle", "axle")}
        fewer = {"accelerations alone": _short(policy, observe=["accelerations"])}
        ran = (
            f"{len(SEEDS)} lane changes on class D, in a process of its own: return "
            f"{first.returns.mean():.2f}, always ride {ride:.2f}, always handling {handling:.2f}"
        )

        def driven_twice() -> _Verdict:
            with PolicyProcess(reference, settings, limits) as fresh:
                return _again(fresh, first.actions, "driven twice")

        results = [
            CheckResult("runs", True, ran),
            _attempt("actions", lambda: _with_refusals(spaces), policy),
            _attempt("observations", lambda: _with_refusals(fewer), policy),
            _attempt("repeat", driven_twice, policy),
            _attempt("reset", lambda: _again(policy, first.actions, "after other drives"), policy),
            _attempt("vehicles", lambda: _alone(policy, first.actions), policy),
            _attempt("sensors", lambda: _damaged_sensors(policy, first.observations), policy),
        ]
        return [*results, *_costs(limits, seconds, policy.peak_memory)]


def _attempt(name: str, check: Callable[[], _Verdict], policy: PolicyProcess) -> CheckResult:
    try:
        passed, message = check()
    except (PolicyError, ConfigError) as error:
        passed, message = False, str(error)
        policy.close()  # the next check begins with a new process
    return CheckResult(name, passed, message)


def _with_refusals(attempts: Mapping[str, Callable[[], object]]) -> _Verdict:
    """Run attempts by description; a refusal by an error of _REFUSALS is noted, not failed."""
    refused = []
    for what, attempt in attempts.items():
        try:
            attempt()
        except PolicyError as error:
            if not str(error).startswith(_REFUSALS):
                return False, f"{what}: {error}"
            refused.append(f"{what} refused: {str(error).partition(': ')[2]}")
    return (None, "; ".join(refused)) if refused else (True, f"{', '.join(attempts)}: valid")


def _short(policy: PolicyProcess, **changed: Any) -> Callable[[], object]:
    options = {**OPTIONS, "length": 10.0, **changed}
    return lambda: roll_out(policy, options, SEEDS[:2], store_observations=False)


def _again(policy: PolicyProcess, actions: np.ndarray, when: str) -> _Verdict:
    return _compare(roll_out(policy, dict(OPTIONS), SEEDS).actions, actions, when)


def _alone(policy: PolicyProcess, actions: np.ndarray) -> _Verdict:
    alone = roll_out(policy, dict(OPTIONS), SEEDS[:1]).actions
    passed, message = _compare(alone[:, 0], actions[: len(alone), 0], "driven alone")
    if passed:
        return True, message
    return None, f"{message}: a comparison depends on which roads are driven together"


def _compare(found: np.ndarray, expected: np.ndarray, when: str) -> _Verdict:
    if found.shape != expected.shape:
        return False, f"{when}: another number of intervals"
    different = int(np.count_nonzero(found != expected))
    return different == 0, f"{when}: {different} of {expected.size} actions differ"


def _damaged_sensors(policy: PolicyProcess, observations: np.ndarray) -> _Verdict:
    setup = EnvSetup({**OPTIONS, "truth": False})
    context = PolicyContext.from_setup(setup, len(SEEDS), POLICY_SEED)
    slices = setup.observation_slices
    policy.reset(context)
    for k, row in enumerate(observations[:50]):
        damaged = row.copy()
        damaged[:, slices["RF"]] = 0.0
        damaged[:, slices["LR"]] = setup.instruments.range * (-1.0) ** k
        validate_actions(policy.act(damaged), context)
    return True, "one accelerometer dead, one saturated: valid actions"


def _costs(limits: Limits, seconds: Sequence[float], memory: float) -> list[CheckResult]:
    """Check memory, and the `seconds` of each call with the vehicles of SEEDS, against the limits
    of a comparison; the longest call, which may prepare tables, counts once.
    """
    calls = SafeOptions().control_rate * 30.0  # [s] of the longest drive of a comparison
    once = max(seconds)
    per_call = (sum(seconds) - once) / max(len(seconds) - 1, 1)
    predicted = once + per_call * calls * 2 * PUBLIC_DRIVES / len(SEEDS)
    cost = (
        f"{once:.2g} s once and {1e6 * per_call / len(SEEDS):.0f} µs per vehicle and interval: at "
        f"most {predicted:.2g} s for {2 * PUBLIC_DRIVES} drives, the limit is {limits.seconds:g} s"
    )
    peak = f"peak {memory:.2f} GiB, the limit is {limits.memory:g} GiB"
    return [
        CheckResult("time", predicted < limits.seconds, cost),
        CheckResult("memory", memory < limits.memory, peak),
    ]
