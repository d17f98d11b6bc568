"""Tables of pages that are copies of kept outputs."""

import pytest

from road_envs.core.code_digest import ROOT
from road_envs.core.config import ConfigError
from studies.pages import pages, with_outputs, write_pages

PAGE = "Before.\n\n<!-- output: runs/a.txt 1 -->\n```text\nold\n```\n\nAfter.\n"
OUTPUT = "$ command --seeds 2\ntable\n1 2\n\nsecond\n3 4\n"


def test_a_copy_is_the_part_of_the_output_without_commands():
    assert with_outputs(PAGE, lambda path: OUTPUT) == PAGE.replace("old", "second\n3 4")
    whole = PAGE.replace("a.txt 1", "a.txt")
    assert "```text\ntable\n1 2\n\nsecond\n3 4\n```" in with_outputs(whole, lambda path: OUTPUT)


def test_a_copy_may_have_some_lines_of_a_part():
    some = PAGE.replace("a.txt 1", "a.txt 1 /^(3|second) ?/")
    assert with_outputs(some, lambda path: OUTPUT + "1 3\n") == some.replace("old", "second\n3 4")


def test_an_empty_block_is_filled_and_what_follows_it_stays():
    empty = PAGE.replace("old\n", "")
    more = "\n## Next\n\n```sh\nls\n```\n"
    assert with_outputs(empty + more, lambda path: OUTPUT) == (
        PAGE.replace("old", "second\n3 4") + more
    )


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_no_block_of_code_begins_within_another(page):
    is_open = False
    for line in page.read_text(encoding="utf-8").splitlines():
        if line.lstrip().startswith("```"):
            assert not (is_open and line.strip() != "```"), line
            is_open = not is_open
    assert not is_open


def test_a_part_that_the_output_lacks_is_refused():
    with pytest.raises(ConfigError, match=r"runs/a.txt has 1 parts, and a page asks for part 1"):
        with_outputs(PAGE, lambda path: "one")


def test_rows_of_json_become_a_table_with_verdicts_in_words():
    page = "A.\n\n<!-- rows: b.json what met -->\n\n| old |\n|---|\n\nB.\n"
    rows = '[{"what": "speed", "met": true}, {"what": "size", "met": null, "x": 1}]'
    table = "| what | met |\n| --- | --- |\n| speed | met |\n| size |  |\n"
    written = with_outputs(page, lambda path: rows)
    assert written == f"A.\n\n<!-- rows: b.json what met -->\n\n{table}\nB.\n"
    assert with_outputs(written, lambda path: rows) == written


def test_pages_are_written_only_where_they_change(tmp_path):
    (tmp_path / "docs/deep").mkdir(parents=True)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs/a.txt").write_text(OUTPUT)
    (tmp_path / "README.md").write_text("No copy.")
    (tmp_path / "docs/deep/page.md").write_text(PAGE)
    assert write_pages(tmp_path) == [tmp_path / "docs/deep/page.md"]
    assert write_pages(tmp_path) == []
    (tmp_path / "runs/a.txt").unlink()
    with pytest.raises(ConfigError, match=r"a page shows runs/a.txt, which cannot be read"):
        write_pages(tmp_path)


def test_every_copy_in_readme_and_docs_is_the_kept_output():
    copies = 0
    for page in pages():
        text = page.read_text(encoding="utf-8")
        copies += text.count("<!-- output: ")
        assert with_outputs(text, lambda path: (ROOT / path).read_text("utf-8")) == text, page
    assert copies >= 1


def test_scores_become_cells_best_first():
    page = (
        "<!-- scores: a.csv nrmse .2f; nrmse +.1f Belgian; coverage .0% -->\n\n"
        "| | all | Belgian | inside |\n|---|---|---|---|\n| `b` | old |\n| `a` |\n\nEnd.\n"
    )
    rows = (
        "estimator,group,nrmse,coverage\na,,0.214,0.456\na,Belgian,0.11,\nb,,0.1,\nb,Belgian,2,\n"
    )
    wanted = "| `b` | 0.10 | +2.0 |  |\n| `a` | 0.21 | +0.1 | 46 % |\n\nEnd.\n"
    written = with_outputs(page, lambda path: rows + "c,,0,0\n")
    assert written.endswith(f"|---|\n{wanted}")
    assert with_outputs(written, lambda path: rows) == written
    with pytest.raises(ConfigError, match=r"a.csv has no .*Belgian.* of a, which a page shows"):
        with_outputs(page, lambda path: rows.replace("a,Belgian", "a,bumps"))
