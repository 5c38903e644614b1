"""The ```python snippets of README and docs run, page by page, top to bottom."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(path for path in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
SUBCOMMANDS = ("hands add", "hands check", "plan show", "plan states", "plan sample")
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9.-]*[a-z0-9]")
FENCE = re.compile(r"^```python\n(.*?)^```$", re.M | re.S)


def snippets(page: Path) -> list[str]:
    """The snippets, each behind as many empty lines as stand before it on the page."""
    text = page.read_text()
    found = FENCE.finditer(text)
    return ["\n" * text.count("\n", 0, match.start(1)) + match.group(1) for match in found]


WITH_SNIPPETS = [page for page in PAGES if snippets(page)]
# its commands come before its snippets: tests/cli/test_add_your_hand.py runs both
FOLLOWED = {"add-your-hand.md"}


@pytest.mark.parametrize(
    "page", [p for p in WITH_SNIPPETS if p.name not in FOLLOWED], ids=lambda page: page.name
)
def test_snippets_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    codes = snippets(page)
    if any("DEXCTL_MENAGERIE" in code for code in codes):
        monkeypatch.setenv("DEXCTL_MENAGERIE", str(request.getfixturevalue("menagerie")))
    if any("import gymnasium" in code for code in codes):
        pytest.importorskip("gymnasium", reason="the extra 'learning' is not installed")
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "__main__"}
    for code in codes:
        exec(compile(code, str(page), "exec"), namespace)


def test_pages_with_code_are_found() -> None:
    assert {"quickstart.md", "add-your-hand.md", "equations.md"} <= {p.name for p in WITH_SNIPPETS}


def test_links_between_files_lead_somewhere() -> None:
    assert [
        f"{page.name} links to {target}"
        for page in PAGES
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text())
        if "://" not in target
        and not target.startswith("out/")
        and not (page.parent / target).exists()
    ] == []


def test_options_exist(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("dynamixel_sdk", reason="the extra 'hardware' is not installed")
    from dexctl.cli import main
    from dexctl.cli.commands import commands
    from hardware.cli import COMMANDS

    names = ["", *SUBCOMMANDS, *(name for name in commands() if name != "hardware")]
    known: dict[str, set[str]] = {}
    for name in [*names, *(f"hardware {name}" for name in COMMANDS)]:
        assert main([*name.split(), "--help"]) == 0
        known[name] = set(OPTION.findall(capsys.readouterr().out))
    every = set().union(*known.values())
    every |= {option.partition(".")[0] for option in every}  # "under `--env`"
    wrong = []
    for page in PAGES:
        text = page.read_text().replace("\\\n", " ")
        wrong += [
            f"{page.name}: {option}" for option in OPTION.findall(text) if option not in every
        ]
        for name, rest in re.findall(
            rf"dexctl (hardware [a-z]+|{'|'.join(SUBCOMMANDS)}|[a-z-]+)\b([^`\n]*)", text
        ):
            wrong += [
                f"{page.name}: dexctl {name} {option}"
                for option in OPTION.findall(rest)
                if name in known and option not in known[name]
            ]
    assert wrong == []
