"""``main``: finds the command, runs it, and turns what happens into an exit code.

0 it went well; 1 it failed; 2 the arguments are wrong; 130 interrupted with Ctrl-C.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from dexctl.cli.checks import no_empty_folders
from dexctl.cli.commands import Command, commands, find
from dexctl.exceptions import DexctlError, InvalidInput, UnknownName

OK, FAILED, BAD_ARGUMENTS, INTERRUPTED = 0, 1, 2, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``dexctl`` with ``argv`` (default: the process's arguments); returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        code = _dispatch(arguments)
        sys.stdout.flush()
    except KeyboardInterrupt as stop:  # what was saved, where something was
        return _complain(stop, INTERRUPTED, otherwise="interrupted")
    except BrokenPipeError:
        # whoever read our output has gone; keep Python from complaining once more when it exits
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (InvalidInput, UnknownName) as error:
        return _complain(error, BAD_ARGUMENTS)
    except DexctlError as error:
        return _complain(error, FAILED)
    except (OSError, MemoryError) as error:
        return _complain(error, FAILED, otherwise="out of memory")
    return code


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_overview())
        return OK if arguments else BAD_ARGUMENTS
    if arguments[0] in ("-V", "--version"):
        from dexctl import __version__

        print(f"dexctl {__version__}")
        return OK
    name, *rest = arguments
    target, title = find(name).load(), f"dexctl {name}"
    if not isinstance(target, type):
        known = dict(target)
        own = known.pop("", None)
        if own is not None and (not rest or rest[0].startswith("-")):
            return _run(own, title, rest)
        if not rest or rest[0] in ("-h", "--help"):
            lines = [f"usage: {title} <command> [options]", "", "commands:"]
            lines += [f"  {sub:<13} {_first_line(kind)}" for sub, kind in known.items()]
            print("\n".join(lines))
            return OK if rest else BAD_ARGUMENTS
        if rest[0] not in known:
            raise UnknownName(f"{title} command", rest[0], known)
        target, title, rest = known[rest[0]], f"{title} {rest[0]}", rest[1:]
    return _run(target, title, rest)


def _run(target: type[Command], title: str, arguments: list[str]) -> int:
    from dexctl.cli.parsing import parse

    command = parse(target, title, arguments)
    if command is None:
        return OK
    with no_empty_folders():
        return int(command.run() or OK)


def _overview() -> str:
    lines = [
        "usage: dexctl <command> [options]",
        "",
        "Controllers for multi-fingered robot hands.",
        "",
        "commands:",
        *(f"  {name:<13} {entry.summary}" for name, entry in commands().items()),
        "",
        "`dexctl <command> --help` lists its options; `dexctl --version` says which this is.",
        "Exit codes: 0 fine, 1 failed, 2 bad arguments, 130 interrupted.",
    ]
    return "\n".join(lines)


def _first_line(kind: type) -> str:
    return (kind.__doc__ or "").strip().partition("\n")[0]


def _complain(error: BaseException, code: int, otherwise: str = "") -> int:
    """One line: what the error says, and its notes."""
    said = "; ".join([str(error) or otherwise, *getattr(error, "__notes__", ())])
    print(f"dexctl: {' '.join(said.split())}", file=sys.stderr)
    return code
