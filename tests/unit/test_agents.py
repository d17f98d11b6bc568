"""The bar of the learners: each of its clauses fails alone, and the table says which."""

import copy
import sys

import numpy as np
import pytest

from studies import agents

SIZE = 20  # five pairs of each group, known and unseen


@pytest.fixture(autouse=True)
def few_drives(monkeypatch):
    monkeypatch.setattr(agents, "DRIVES", SIZE // 2)


def row(policy, score, seed=0, violated=0):
    """A row with equal scores on all drives, of which the first ones are violated."""
    return {
        "policy": policy,
        "seed": seed,
        "curve": [[1, score - 1.0], [2, score]],
        "seconds": 60.0,
        "machine": "one core",
        "scores": {name: [score] * SIZE for name in agents.SETS},
        "violated": {name: [k < violated for k in range(SIZE)] for name in agents.SETS},
    }


@pytest.fixture
def rows():
    laws = [row("rrms", -1.0, violated=2), row("rrms_lateral", -0.9), row("ride/ride", -5.0)]
    learned = [row("learned", -0.8, seed, violated=2) for seed in (1, 2)]
    return [*laws, row("mpc", -0.5), *learned]


def missed(rows):
    return agents.Results(rows).missed("learned")


def test_a_learner_above_every_law_reaches_the_bar(rows):
    assert missed(rows) == []
    law, gain = agents.Results(rows).hardest("learned", "unseen")
    assert law == "rrms_lateral" and gain["mean"] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("part", "drives", "chosen"),
    [("S3", "S3", slice(None)), ("mirrored", "public", slice(1, None, 2))],
)
def test_a_learner_that_is_below_a_law_on_one_part_misses_it(rows, part, drives, chosen):
    for each in rows[-2:]:
        scores = np.array(each["scores"][drives])
        scores[chosen] = -0.95
        scores[[k for k in range(SIZE) if k not in range(SIZE)[chosen]]] = -0.1
        each["scores"][drives] = scores.tolist()
    assert missed(rows) == [f"not above every law: {part}"]


def test_one_bad_seed_of_two_opens_the_interval(rows):
    rows[-1]["scores"]["public"] = [-0.95] * SIZE
    assert missed(rows)[0].startswith("not above every law: public, mirrored, unseen")


def test_a_group_below_ride_and_more_violations_are_named(rows):
    worse = copy.deepcopy(rows)
    worse[2]["scores"]["public"] = [-0.78] * SIZE
    assert missed(worse)[-1].startswith("below ride: known, unseen, left, right")
    worse = copy.deepcopy(rows)
    worse[-1]["violated"]["public"] = [True] * SIZE
    assert missed(worse) == ["violates in 55% of the public drives, rrms in 10%"]


def test_the_summary_has_the_bar_the_groups_and_the_curves(rows, tmp_path):
    text = agents.summary(rows)
    assert "bar: reached" in text and "learned 2: public +0.200" in text
    assert "\nlearned trained with one core\n" in text and "mpc trained" not in text
    assert "over mpc" in text and "-0.300 (-0.300 to -0.300)" in text
    assert "unseen                  +0.100 (+0.100 to +0.100)         +4.200" in text
    agents.draw(rows, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 0


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--learner=learned=2", "--learner=ppo=1"], {"learned": 2, "ppo": 1}),
        (["--learner=qrdqn"], {"qrdqn": 5}),
        ([], dict.fromkeys(agents.LEARNERS, 5)),
    ],
)
def test_a_learner_is_trained_from_the_seeds_that_are_asked_for(words, expected, monkeypatch):
    cases = []
    monkeypatch.setattr(agents, "run_study", lambda chosen, wanted, *rest: cases.extend(wanted))
    monkeypatch.setattr(sys, "argv", ["agents", "rows.jsonl", *words])
    agents.main()
    trained = [(name, seed + 1) for name, seeds in expected.items() for seed in range(seeds)]
    found = [(case["policy"], case["seed"]) for case in cases]
    assert [case for case in found if case[0] in agents.LEARNERS] == trained
    assert {("ride/ride", 0), ("mpc", 0)} <= set(found)


def test_an_unknown_learner_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["agents", "rows.jsonl", "--learner", "pop=2"])
    with pytest.raises(SystemExit):
        agents.main()
    assert "invalid learner value: 'pop=2'" in capsys.readouterr().err
