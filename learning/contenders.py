"""What can be evaluated: policy files and controllers, and what they were trained in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dexctl import controllers, hands
from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput, UnknownName
from learning import policies
from learning.envs.config import EnvConfig, unit_axis
from learning.policies import Policy
from learning.transfer import Trained


def load_contender(
    text: str,
    *,
    hand: str | None = None,
    parts: Sequence[str] | None = None,
) -> Controller:
    """A policy file (``.npz``), or a controller by name.

    Args:
        text: the path or the name.
        hand: name of the hand; None is the policy's own, or dex5.
        parts: refuse a policy that was trained with other observation parts than these.

    Raises:
        InvalidInput: no such policy file, or one of another hand, version, or with other parts.
        UnknownName: no such controller.
    """
    if text.endswith(".npz"):
        return policies.load(Path(text).expanduser(), hand=hand, parts=parts)
    if text not in controllers.names():
        raise UnknownName("policy", text, ["a policy file (.npz)", *controllers.names()])
    return controllers.make(text, hands.load(hand or "dex5"))


def trained_env(name: str, controller: Controller) -> EnvConfig | None:
    """What the card of a policy says that it was trained in; None where it does not say.

    Raises:
        InvalidInput: the card says it in a way that this version does not know.
    """
    if not isinstance(controller, Policy):
        return None
    trained = controller.card.get("trained")
    if trained is None:
        return None
    try:
        return EnvConfig(**trained["env"])
    except (TypeError, KeyError, InvalidInput, UnknownName) as error:
        raise InvalidInput(
            f"the card of policy {name!r} is of another version: its environment {error}"
        ) from None


def load_trained(
    texts: Sequence[str],
    *,
    hand: str | None = None,
    parts: Sequence[str] | None = None,
) -> list[Trained]:
    """Policies, each with the object that it was trained on.

    Args:
        texts: paths of policy files, or ``object=path``, or ``object=controller``.
        hand, parts: see `load_contender`.

    Raises:
        InvalidInput: the object of one is not known; or see `load_contender`.
    """
    found = []
    for text in texts:
        given, separator, rest = text.partition("=")
        name = rest if separator and "/" not in given else text
        controller = load_contender(name, hand=hand, parts=parts)
        if name is not text:
            found.append(Trained(name, given, controller))
            continue
        env = trained_env(name, controller)
        objects = () if env is None else env.objects
        if len(objects) != 1:
            says = f"was trained on {' and '.join(objects)}" if objects else "has no such card"
            raise InvalidInput(
                f"a transfer matrix needs the one object that each policy was trained on; {name!r} "
                f"{says}: give it, as in {(*objects, 'cube')[0]}={name}"
            )
        found.append(Trained(name, objects[0], controller))
    return found


def as_trained(trained: Sequence[Trained], given: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a protocol: those given, and where None is, what the policies were trained with.

    Args:
        trained: the policies; controllers do not say anything.
        given: by field of `EnvConfig`; None stands for what is not given.

    Raises:
        InvalidInput: the policies were trained with different ones.
    """
    envs = [trained_env(one.name, one.controller) for one in trained]
    known = [env for env in envs if env is not None]
    found = {}
    for name, value in given.items():
        values = list(dict.fromkeys(getattr(env, name) for env in known))
        if value is None and len(values) > 1:
            raise InvalidInput(
                f"the policies were trained with {name} {' and '.join(map(str, values))}; "
                f"say which with --{name.replace('_', '-')}"
            )
        default = values[0] if values else getattr(EnvConfig, name)
        found[name] = default if value is None else value
    return found


def aimed(trained: Sequence[Trained], axis: str | tuple[float, ...]) -> list[Trained]:
    """The same, with the controllers among them turning the object about ``axis``."""
    return [
        one
        if isinstance(one.controller, Policy)
        else one._replace(
            controller=controllers.make(one.name, one.controller.hand, axis=unit_axis(axis))
        )
        for one in trained
    ]
