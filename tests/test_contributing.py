"""What CONTRIBUTING and the other files for whoever carries on say is there."""

from __future__ import annotations

import os
import re
import subprocess
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_every_file_that_contributing_names_is_there() -> None:
    names = set(re.findall(r"`([\w./-]+/[\w./-]*|[\w-]+\.(?:md|toml))`", (ROOT / "CONTRIBUTING.md").read_text()))
    assert len(names) > 40
    assert [name for name in sorted(names) if not (ROOT / name).exists()] == []


def test_contributing_names_every_package() -> None:
    table = (ROOT / "CONTRIBUTING.md").read_text()
    packages = [path for path in (ROOT / "waldnet").iterdir() if path.is_dir() and path.name != "__pycache__"]
    missing = [p.name for p in packages if f"`{p.name}/`" not in table and f"`waldnet/{p.name}/`" not in table]
    assert missing == []


def test_the_citation_has_the_version_of_the_package() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"].get("version")
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited is not None
    assert version in (None, cited[1])


def test_the_hook_checks_commits_of_code_and_no_others(tmp_path: Path) -> None:
    (tmp_path / "Makefile").write_text("check:\n\t@echo checked; false\n")
    env = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}

    def hook(name: str) -> tuple[int, str]:
        (tmp_path / name).write_text("x = 1\n")
        subprocess.run(["git", "add", name], cwd=tmp_path, env=env, check=True)
        done = subprocess.run([ROOT / ".ci/hooks/pre-commit"], cwd=tmp_path, env=env, capture_output=True, text=True)
        return done.returncode, done.stdout

    subprocess.run(["git", "init", "--quiet"], cwd=tmp_path, env=env, check=True)
    assert hook("page.md") == (0, "")
    failed, said = hook("code.py")
    assert (failed != 0, said) == (True, "checked\n")
