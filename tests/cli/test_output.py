"""What commands print is what they were given: brackets are nobody's markup."""

from __future__ import annotations

from pathlib import Path

import pytest

from dexctl.cli.output import facts, notes, progress, results, table
from dexctl.exceptions import InvalidInput

ODD = "[servos] of hand[0].toml, [/x], [bold] and :warning:"
ROOMS = Path(__file__).resolve().parents[2]


def test_text_is_printed_as_it_is(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    shown = table(ODD, "right", right=("right",))
    shown.add_row(ODD, "1")
    for printed in (ODD, shown, facts([(ODD, ODD)])):
        results().print(printed)
    said = capsys.readouterr().out
    assert said.count(ODD) == 5 and "\\" not in said
    notes().print(ODD, style="bold")
    assert ODD in capsys.readouterr().err
    with progress(notes()) as bar:
        bar.add_task("[/x] of [servos]")
    assert "[/x] of [servos]" in capsys.readouterr().err


def test_nobody_writes_markup() -> None:
    found = [
        f"{path.relative_to(ROOMS)}: {mark}"
        for room in ("dexctl", "learning", "hardware")
        for path in sorted((ROOMS / room).rglob("*.py"))
        for mark in ("[bold", "[/bold", "[red", "[dim", "markup=True", r" \[N]", r" \[mm]")
        if mark in path.read_text(encoding="utf-8")
    ]
    assert found == []


@pytest.mark.parametrize("wide", [False, True], ids=["pipe", "terminal"])
def test_a_bar_is_gone_after_what_went_wrong(
    wide: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It stayed above the message of `dexctl plan sample`."""
    if wide:
        monkeypatch.setenv("TTY_COMPATIBLE", "1")
    console = notes()
    assert console.is_terminal == wide

    def fail(error: BaseException) -> None:
        with progress(console) as bar:
            bar.add_task("grasps")
            raise error

    with pytest.raises(InvalidInput):
        fail(InvalidInput("no grasp was found"))
    said = capsys.readouterr().err
    assert said.endswith("\x1b[1A\x1b[2K") if wide else said == ""
    with pytest.raises(KeyboardInterrupt):
        fail(KeyboardInterrupt())
    assert "grasps" in capsys.readouterr().err
