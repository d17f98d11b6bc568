"""A study computes a case once, over several runs, and reports on all results."""

import json

from studies.study import run_study, study_parser


def test_results_that_are_kept_are_not_computed_again(tmp_path, capsys):
    computed, drawn = [], []

    def compute(road, grade):
        computed.append((road, grade))
        return {"error": len(computed)}

    def run(cases):
        options = study_parser("").parse_args([str(tmp_path / "r.jsonl"), "--plot", "p.png"])
        run_study(
            options, cases, compute, lambda rows: f"{len(rows)} rows", lambda *x: drawn.append(x)
        )
        return capsys.readouterr().out

    first, second = {"road": 0, "grade": "S0"}, {"road": 0, "grade": "S1"}
    assert run([first]) == "1 rows\n"
    assert run([first, second]) == "2 rows\n"
    assert computed == [(0, "S0"), (0, "S1")]
    lines = (tmp_path / "r.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line) for line in lines] == [first | {"error": 1}, second | {"error": 2}]
    assert [(len(rows), path.name) for rows, path in drawn] == [(1, "p.png"), (2, "p.png")]
