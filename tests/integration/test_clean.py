"""The command `clean`."""

from leaderboard.commands import results
from road_envs.core import artifacts
from road_envs.core.artifacts import Kind


def test_clean_lists_then_deletes_stale_artifacts(road_recon, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(artifacts, "code_version", lambda *modules: "before")
        Kind("card", 1, ("road_envs.core.config",)).write(tmp_path / "out" / "a.json", {"x": 1})
    code, out, _ = road_recon("clean", "out", "--dry-run")
    assert code == 0 and "out/a.json" in out and "1 stale artifacts below out would be" in out
    assert road_recon("clean", "out")[1] == "1 stale artifacts below out deleted\n"
    assert list((tmp_path / "out").iterdir()) == []
    code, _, err = road_recon("clean", "nowhere")
    assert code == 2 and "nowhere: no such folder" in err


def test_clean_deletes_kernels_that_other_code_has_compiled_and_no_other_folder(
    road_recon, tmp_path, monkeypatch
):
    own, other, foreign = (tmp_path / "cache" / (16 * x) for x in "abc")
    for folder in (own, other, foreign):
        (folder / "0123456789abcdef").mkdir(parents=True)
        (folder / "0123456789abcdef" / "f-m.py311.nbi").write_bytes(b"")
    (foreign / "notes.txt").write_text("of the user")
    monkeypatch.setattr(results, "cache_home", lambda: tmp_path / "cache")
    monkeypatch.setattr(results._numba, "CACHE", own)
    assert str(other) in road_recon("clean", "--dry-run")[1] and other.exists()
    assert "\n" not in road_recon("clean")[1].strip()
    assert own.exists() and foreign.exists() and not other.exists()
