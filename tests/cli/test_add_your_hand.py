"""`docs/add-your-hand.md`, followed word for word: its commands and its snippets, top to bottom."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest

from dexctl.cli import main

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "add-your-hand.md"
BLOCK = re.compile(r"^```(bash|python)\n(.*?)^```$", re.M | re.S)
HANDS = ROOT / "tests" / "hands"
FILES = {"my_hand.urdf": HANDS / "ring.urdf", "my_hand.xml": HANDS / "four_fingers.xml"}


@pytest.mark.slow
@pytest.mark.parametrize("file", FILES)
def test_the_page_word_for_word(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(FILES[file], tmp_path / file)
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {"__name__": "__main__"}
    ran = []
    for language, text in BLOCK.findall(PAGE.read_text()):
        if language == "python":
            exec(compile(text, str(PAGE), "exec"), namespace)
            continue
        for line in text.splitlines():
            program, *words = shlex.split(line.replace("my_hand.urdf", file))
            assert program == "dexctl"
            assert main(words) == 0, f"{line}: {capsys.readouterr()}"
            ran.append(words[0])
    assert ran == ["hands", "hands", "rotate"]
    assert (tmp_path / "my_hand.toml").is_file()
    assert (tmp_path / "my_hand" / "report.html").is_file()
