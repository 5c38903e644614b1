"""The parts of a sweep's file: each is checked, and what is wrong is named in one line."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Any

from dexctl import controllers
from dexctl.exceptions import InvalidInput, UnknownName
from learning.envs import EnvConfig
from learning.evaluate import Protocol
from learning.exploration import GuidanceConfig
from learning.recipes import recipe
from learning.settings import TrainConfig

_ELSEWHERE = ("env", "guidance", "controllers", "seed")  # of TrainConfig: tables, or the matrix


@dataclass(frozen=True, kw_only=True)
class EvaluationPlan:
    """How the policies of a sweep are evaluated.

    Attributes:
        objects: by name, one after the other.
        gravity: which way the palm looks.
        episodes, seconds, seed: as `learning.evaluate.Protocol`'s.
        controllers: evaluated in a policy's place, for comparison.
        hand, control_period: of these.
    """

    objects: tuple[str, ...]
    gravity: str | tuple[float, float, float]
    episodes: int
    seconds: float
    seed: int
    controllers: tuple[str, ...]
    hand: str
    control_period: float


def check_keys(where: str, values: Mapping[str, Any], known: Iterable[str]) -> None:
    """Raise UnknownName where ``values`` has a key that is not known."""
    known = tuple(known)
    for key in values:
        if key not in known:
            raise UnknownName(f"setting of {where}", key, known)


def table(values: Mapping[str, Any], name: str, title: str | None = None) -> Mapping[str, Any]:
    """The table ``name``, empty where there is none."""
    found = values.get(name, {})
    if not isinstance(found, Mapping):
        raise InvalidInput(f"{title or name} is {found!r}; expected a table [{title or name}]")
    return found


def check_different(what: str, values: Sequence[Any]) -> None:
    """Raise InvalidInput where a value is there twice."""
    for i, value in enumerate(values):
        if value in values[:i]:
            raise InvalidInput(f"{what} has {value!r} twice")


def groups(values: Any) -> list[tuple[str, ...]]:
    """Controllers: names, or lists of names that guide together."""
    if not isinstance(values, list):
        raise InvalidInput(f"controllers is {values!r}; expected a list of names")
    found = []
    for value in values:
        group = tuple(value) if isinstance(value, list) else (value,)
        if not group:
            raise InvalidInput("controllers has an empty list; expected names")
        for name in group:
            if not isinstance(name, str) or name not in controllers.names():
                raise UnknownName("controller", name, controllers.names())
        check_different("a group of controllers", group)
        found.append(group)
    check_different("controllers", found)
    return found


def seeds(value: Any) -> list[int]:
    """Seeds: a list of them, or how many, from 0 on."""
    if _whole(value, 1):
        return list(range(value))
    if not isinstance(value, list) or not value or not all(_whole(one, 0) for one in value):
        raise InvalidInput(
            f"seeds is {value!r}; expected how many, or a list of whole numbers from 0 on"
        )
    check_different("seeds", value)
    return value


def merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with what ``over`` has, tables within tables included."""
    found = dict(base)
    for key, value in over.items():
        before = found.get(key)
        if isinstance(value, Mapping) and isinstance(before, Mapping):
            found[key] = merged(before, value)
        else:
            found[key] = value
    return found


def check_settings(values: Mapping[str, Any], where: str) -> None:
    """Raise UnknownName where [train] or [method.METHOD] names a setting that there is not."""
    check_keys(where, values, (*_names(TrainConfig, _ELSEWHERE), "env", "guidance", "recipe"))
    check_keys(f"{where}.env", table(values, "env", f"{where}.env"), _names(EnvConfig))
    guidance = table(values, "guidance", f"{where}.guidance")
    check_keys(f"{where}.guidance", guidance, _names(GuidanceConfig, ("method",)))


def train_config(
    settings: Mapping[str, Any], method: str, names: tuple[str, ...], seed: int
) -> TrainConfig:
    """The configuration of one run, from [train] with what [method.METHOD] changes.

    Both go before the settings of a recipe that one of them names.
    """
    if "recipe" in settings:
        chosen = recipe(settings["recipe"], method)
        given = {key: value for key, value in settings.items() if key != "recipe"}
        base = {**chosen.training, "env": chosen.env, "guidance": chosen.guidance}
        settings = merged(base, given)
    top = {key: value for key, value in settings.items() if key not in ("env", "guidance")}
    env = _options(EnvConfig, table(settings, "env"), "train.env")
    guidance = _options(GuidanceConfig, table(settings, "guidance"), "train.guidance")
    made = _made(
        TrainConfig,
        "train",
        **_options(TrainConfig, top, "train"),
        # one thread for each run: several are run side by side
        env=_made(EnvConfig, "train.env", **{"threads": 1, **env}),
        guidance=_made(GuidanceConfig, "train.guidance", method=method, **guidance),
        controllers=names,
        seed=seed,
    )
    _check_objects("train.env.object", made.env.objects)
    _check_gravity(made.env.gravity)
    return made


def evaluation(values: Mapping[str, Any], env: EnvConfig, needed: Sequence[str]) -> EvaluationPlan:
    """The table [evaluation]; objects and gravity are those trained with, unless it has others.

    Args:
        values: the table.
        env: of the first run.
        needed: controllers that are to be evaluated beside those that it names.
    """
    check_keys(
        "evaluation", values, ("objects", "gravity", "episodes", "seconds", "seed", "controllers")
    )
    objects = values.get("objects", list(env.objects))
    if not isinstance(objects, list) or not objects:
        raise InvalidInput(f"evaluation.objects is {objects!r}; expected a list of names")
    check_different("evaluation.objects", objects)
    _check_objects("evaluation.objects", objects)
    gravity = values.get("gravity", env.gravity)
    gravity = tuple(gravity) if isinstance(gravity, list) else gravity
    _check_gravity(gravity)
    number = values.get("seed", 0)
    if not _whole(number, 0):
        raise InvalidInput(f"evaluation.seed is {number!r}; expected a whole number from 0 on")
    protocol = _made(
        Protocol,
        "evaluation",
        episodes=values.get("episodes", 100),
        seconds=values.get("seconds", 60.0),
    )
    if protocol.seconds < env.control_period:
        raise InvalidInput(
            f"evaluation.seconds is {protocol.seconds}; expected at least one control period of "
            f"{env.control_period}"
        )
    compared = groups(values.get("controllers", []))
    for group in compared:
        if len(group) > 1:
            raise InvalidInput(
                f"evaluation.controllers has {list(group)}; each is evaluated by itself"
            )
    return EvaluationPlan(
        objects=tuple(objects),
        gravity=gravity,
        episodes=protocol.episodes,
        seconds=float(protocol.seconds),
        seed=number,
        controllers=tuple(dict.fromkeys([*(group[0] for group in compared), *needed])),
        hand=env.hand,
        control_period=env.control_period,
    )


def _check_objects(what: str, names: Sequence[Any]) -> None:
    from dexctl.sim import object_names

    for name in names:
        if name not in object_names():
            raise UnknownName(f"object in {what}", name, object_names())


def _check_gravity(gravity: Any) -> None:
    from dexctl.sim.scene import gravity_vector

    gravity_vector(gravity)


def _whole(value: Any, least: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _names(kind: type, left_out: Iterable[str] = ()) -> tuple[str, ...]:
    return tuple(one.name for one in fields(kind) if one.name not in left_out)


def _made(kind: type, where: str, **options: Any) -> Any:
    try:
        return kind(**options)
    except TypeError as error:  # a list where a number belongs, and the like
        raise InvalidInput(f"[{where}] has a value of the wrong kind: {error}") from None


def _options(kind: type, values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """What a dataclass takes, from TOML: its lists are tuples, its whole numbers may be floats."""
    defaults = {one.name: one.default for one in fields(kind)}
    found = {}
    for name, value in values.items():
        default = defaults[name]
        if default is not MISSING and isinstance(value, bool) != isinstance(default, bool):
            wanted = "true or false" if isinstance(default, bool) else "no truth value"
            raise InvalidInput(f"{where}.{name} is {value!r}; expected {wanted}")
        if isinstance(default, str) and not isinstance(value, str | list):
            raise InvalidInput(f"{where}.{name} is {value!r}; expected a name")
        if isinstance(default, float) and isinstance(value, int):
            value = float(value)
        found[name] = tuple(value) if isinstance(value, list) else value
    return found
