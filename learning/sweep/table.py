"""The table of a sweep, from its results.json: what people read, on a terminal or in a page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from dexctl import controllers
from dexctl.exceptions import InvalidInput
from dexctl.settings import from_plain, to_plain
from dexctl.sim.scene_config import SceneConfig
from learning.evaluation.protocol import Protocol

METHODS = {"rl": "RL", "rl+bc": "RL+BC", "fge": "FGE", "vge": "VGE", "vge+bc": "VGE+BC"}
NONE = "-"
_SAID = ("object", "gravity", "threads", "episodes", "seconds", "seed")  # in words of their own
FORMAT = 2
_FORMATS = (1, 2)  # the first had the evaluation's objects and gravity without a scene
ROTATION, RETURN, DROPPED = "rotation_median_rad", "return_mean", "share_dropped"


def table(results: Mapping[str, Any], *, titles: bool = True) -> tuple[list[str], list[list[str]]]:
    """Heading and rows, as text.

    Args:
        results: what results.json holds.
        titles: what people read for a controller, or else what commands take.

    Raises:
        InvalidInput: it holds something else.
    """
    _check_format(results)
    objects = objects_of(results)
    several = len(objects) > 1
    header = ["Method", "Controllers", *(["Object"] if several else []), "Seeds", "Learned",
              "Rotation, rad", "Return", "Dropped"]  # fmt: skip
    rows = [
        [
            METHODS[cell["method"]],
            _called(cell["controllers"], titles),
            *([cell["object"]] if several else []),
            _seeds(cell["seeds"]),
            _learned(cell),
            _estimate(cell["rotation_iqm_rad"], 2),
            _estimate(cell["return_iqm"], 0),
            _estimate(cell["dropped_mean"], 0, 100.0, " %"),
        ]
        for cell in results["cells"]
    ]
    for name, found in results["controllers"].items():
        for kind in objects:
            figures = (found["objects"] or {}).get(kind, {})
            rows.append(
                [
                    "no learning",
                    _called([name], titles),
                    *([kind] if several else []),
                    NONE if found["objects"] else found["state"],
                    NONE,
                    _value(figures.get(ROTATION), 2),
                    _value(figures.get(RETURN), 0),
                    _value(figures.get(DROPPED), 0, 100.0, " %"),
                ]
            )
    return header, rows


def caption(results: Mapping[str, Any]) -> str:
    """What the table's figures are, in a paragraph."""
    _check_format(results)
    plan, criterion = results["evaluation"], results["criterion"]["rotation"]
    palm = from_plain(SceneConfig, {"gravity": plan.get("scene", plan)["gravity"]}).palm
    usual = to_plain(Protocol())
    conditions = ", ".join([*objects_of(results), palm, *_unusual(plan, usual)])
    steps = sorted({settings["steps"] for settings in results["settings"].values()})
    if criterion == "guide":
        learned = "at least that of the best controller that guided it (RL: of the best of all)"
    else:
        learned = f"at least {criterion:.4g} rad"
    budget = " or ".join(f"{one:,}" for one in steps)
    return (
        f"{budget} environment steps; {conditions}. "
        f"Each policy: {plan['episodes']} episodes of "
        f"{plan['seconds']:g} s, rotation is their median, return and dropped their mean. Over "
        f"seeds: interquartile mean (dropped: mean) with 95 % bootstrap interval. Learned: seeds "
        f"whose rotation is {learned}, with 95 % Wilson interval."
    )


def _unusual(plan: Mapping[str, Any], usual: Mapping[str, Any]) -> Iterator[str]:
    """The settings of scene and task that are not those of the standard protocol."""
    for name, value in plan.items():
        if isinstance(value, Mapping):
            yield from _unusual(value, usual.get(name, {}))
        elif name in usual and name not in _SAID and value != usual[name]:
            yield f"{name} {value}"


def objects_of(results: Mapping[str, Any]) -> list[str]:
    """The objects that a sweep's policies were evaluated with."""
    plan = results["evaluation"]
    found = plan["objects"] if "objects" in plan else plan["scene"]["object"]
    return list(dict.fromkeys(found))


def markdown_table(results: Mapping[str, Any]) -> str:
    """The table in Markdown, for a page that is generated from results.json.

    Raises:
        InvalidInput: ``results`` are not of a sweep.
    """
    header, rows = table(results)
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _called(names: Sequence[str], titles: bool) -> str:
    return " + ".join(controllers.entry(one).title if titles else one for one in names) or NONE


def _seeds(seeds: Mapping[str, Sequence[int]]) -> str:
    """How many have finished, and what became of the others."""
    done, planned = len(seeds["finished"]), sum(map(len, seeds.values()))
    if done == planned:
        return str(done)
    rest = [f"{len(those)} {state}" for state, those in seeds.items()
            if those and state != "finished"]  # fmt: skip
    return f"{done} of {planned} ({', '.join(rest)})"


def _learned(cell: Mapping[str, Any]) -> str:
    found = cell["learned"]
    if found is None:
        return NONE
    count = round(found["value"] * found["count"])
    low, high = (f"{100 * found[key]:.0f}" for key in ("low", "high"))
    return f"{count}/{found['count']} ({low} to {high} %)"


def _estimate(
    found: Mapping[str, Any] | None, digits: int, factor: float = 1.0, unit: str = ""
) -> str:
    """With its interval, where it has one."""
    if found is None:
        return NONE
    if found["low"] is None:
        return _value(found, digits, factor, unit)
    value, low, high = (_number(factor * found[key], digits) for key in ("value", "low", "high"))
    return f"{value}{unit} ({low} to {high})"


def _value(
    found: Mapping[str, Any] | None, digits: int, factor: float = 1.0, unit: str = ""
) -> str:
    return NONE if not found else _number(factor * found["value"], digits) + unit


def _number(value: float, digits: int) -> str:
    text = f"{value:.{digits}f}"
    return text.removeprefix("-") if float(text) == 0.0 else text


def _check_format(results: Mapping[str, Any]) -> None:
    """Raise InvalidInput where ``results`` are not of a sweep, or of another version's."""
    if results.get("command") != "sweep" or results.get("format") not in _FORMATS:
        raise InvalidInput(
            f"these are results of {results.get('command')!r} in format {results.get('format')}; "
            f"expected 'sweep' in format {FORMAT} or before"
        )
