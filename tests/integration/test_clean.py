"""The command `clean`."""

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
