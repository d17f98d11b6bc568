"""Recipes of `docs/howto/cluster.md`: scripts for a shell, manifests, and commands."""

import re
import shlex
import subprocess
from pathlib import Path

import pytest
import typer
import yaml

from leaderboard.cli import app

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "cluster.md"
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.M | re.S)
SCRIPTS = [text for kind, text in BLOCKS if kind in ("sh", "bash")]
MANIFESTS = [doc for kind, text in BLOCKS if kind == "yaml" for doc in yaml.safe_load_all(text)]


def containers(manifest):
    template = manifest["spec"].get("template", {"spec": {"containers": []}})
    return template["spec"]["containers"]


def commands():
    """Yield every command of this package on the page, in words, without `road-recon`."""
    for script in SCRIPTS:
        for line in script.replace("\\\n", " ").splitlines():
            for quoted in (line, *re.findall(r"'([^']*)'", line)):
                if (start := re.match(r"\s*road-recon\s+(.*)", quoted)) is not None:
                    yield shlex.split(start[1], comments=True)
    for manifest in MANIFESTS:
        for container in containers(manifest):
            if container["command"][0] == "road-recon":
                yield container["command"][1:]


def test_the_page_has_its_recipes():
    assert len(SCRIPTS) == 3 and len(list(commands())) == 5
    assert {words[0] for words in commands()} == {"leaderboard", "run-job"}
    assert [manifest["kind"] for manifest in MANIFESTS] == [
        "Service", "Deployment", "Deployment", "Job",
    ]  # fmt: skip


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_shell_parses_the_script(script):
    checked = subprocess.run(["bash", "-n"], input=script, text=True, capture_output=True)
    assert (checked.returncode, checked.stderr) == (0, "")
    for option in re.findall(r"^#SBATCH (.*)$", script, re.M):
        assert re.fullmatch(r"--[a-z-]+=\S+", option)


@pytest.mark.parametrize("words", list(commands()), ids=" ".join)
def test_the_command_line_accepts_the_command(words):
    group = typer.main.get_command(app)
    context = group.make_context("road-recon", list(words))
    name, command, rest = group.resolve_command(context, list(words))
    command.make_context(name, rest, parent=context)


def test_the_manifests_fit_together():
    by_name = {(m["kind"], m["metadata"]["name"]): m for m in MANIFESTS}
    service = by_name["Service", "dask-scheduler"]
    (port,) = service["spec"]["ports"]
    address = f"tcp://{service['metadata']['name']}:{port['port']}"
    for manifest in MANIFESTS[1:]:
        labels = manifest["spec"]["template"].get("metadata", {}).get("labels")
        assert manifest["spec"].get("selector", {}).get("matchLabels") == labels
        (container,) = containers(manifest)
        words = container["command"]
        assert address in words or words[:4] == ["dask", "scheduler", "--port", str(port["port"])]
    assert service["spec"]["selector"] == MANIFESTS[1]["spec"]["template"]["metadata"]["labels"]
    (volume,) = MANIFESTS[3]["spec"]["template"]["spec"]["volumes"]
    (job,) = containers(MANIFESTS[3])
    (mount,) = job["volumeMounts"]
    assert (mount["name"], mount["mountPath"]) == (volume["name"], job["command"][-1])
