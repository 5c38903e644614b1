"""The project's files agree with each other."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
REQUIREMENTS = [
    Requirement(line)
    for lines in (PROJECT["dependencies"], *EXTRAS.values())
    for line in lines
    if not line.startswith("dexctl[")
]


def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    return dict(line.split("==") for line in lines if line and not line.startswith("#"))


def test_constraints_pin_every_requirement() -> None:
    pinned = pins()
    assert [
        str(requirement)
        for requirement in REQUIREMENTS
        if not requirement.specifier.contains(pinned.get(requirement.name.lower(), "0"))
    ] == []


def test_torch_is_pinned() -> None:
    assert pins()["torch"] == "2.13.0"


def test_all_holds_every_extra_for_users() -> None:
    (line,) = EXTRAS["all"]
    assert Requirement(line).extras == EXTRAS.keys() - {"all", "dev"}


def test_the_version_is_the_same_everywhere() -> None:
    version = PROJECT["version"]
    assert f"\n## {version}" in (ROOT / "CHANGELOG.md").read_text()
    assert re.search(rf"^version: {re.escape(version)}$", (ROOT / "CITATION.cff").read_text(), re.M)


def test_ci_runs_the_pythons_that_the_package_allows() -> None:
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text()
    tested = re.search(r"python: \[(.*)\]", workflow)
    assert tested is not None
    versions = re.findall(r"3\.\d+", tested.group(1))
    assert versions == ["3.11", "3.12", "3.13"]
    declared = [c.rsplit(" ", 1)[1] for c in PROJECT["classifiers"] if ":: 3." in c]
    assert declared == versions
    assert PROJECT["requires-python"] == ">=3.11,<3.14"


def test_make_has_the_targets_that_are_promised() -> None:
    makefile = (ROOT / "Makefile").read_text()
    for target in ("demo", "test", "test-slow", "lint", "bench", "docs", "clean"):
        assert re.search(rf"^{target}:", makefile, re.M), target


def test_nothing_names_a_place_of_one_machine() -> None:
    """Of what is committed as JSON: cards of policies, results, configurations of runs."""
    found = [
        path
        for folder in ("learning", "benchmarks")
        for path in (ROOT / folder).rglob("*.json")
        if re.search(r'"(/|[A-Z]:\\\\)\w', path.read_text())
    ]
    assert found == []
