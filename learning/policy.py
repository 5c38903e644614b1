"""Trained policies as controllers that need numpy only, and the files that hold them.

A policy file is a numpy ``.npz`` of a multilayer perceptron's weights with a JSON text that says
what they are for: hand, observation, action. The card, a JSON file of the same name beside it, says
the same for people, and what trained the policy.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike

import dexctl
from dexctl import hands
from dexctl.controller import Controller, check_action, check_state
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.files import aside, write_text
from dexctl.hand import HandModel
from dexctl.state import Floats, GraspState
from learning.envs.action import SetPointAction
from learning.envs.observation import Observation, check_parts

if TYPE_CHECKING:
    from learning.envs.config import EnvConfig

FORMAT = 1


def _relu(x: Floats) -> Floats:
    return np.maximum(x, 0.0)


def _elu(x: Floats) -> Floats:
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0.0)))


# named functions, so that a policy can be pickled, as other controllers can
ACTIVATIONS: Mapping[str, Callable[[Floats], Floats]] = {
    "relu": _relu,
    "tanh": np.tanh,
    "elu": _elu,
}


class Layer(NamedTuple):
    """One affine layer, ``x -> x @ weight.T + bias``, with torch's shapes.

    Attributes:
        weight: ``(outputs, inputs)``.
        bias: ``(outputs,)``.
    """

    weight: Floats
    bias: Floats


@final
class PolicySpec(NamedTuple):
    """What a policy's weights are for.

    Attributes:
        hand: name of the hand.
        joint_names, fingertip_names: of the hand, in the order that the numbers come in.
        observation: see `learning.envs.Observation.to_dict`.
        action: see `learning.envs.SetPointAction.to_dict`.
        activation: between the layers; behind the last one is tanh.
    """

    hand: str
    joint_names: tuple[str, ...]
    fingertip_names: tuple[str, ...]
    observation: Mapping[str, Any]
    action: Mapping[str, Any]
    activation: str = "relu"

    @classmethod
    def of(
        cls,
        hand: HandModel,
        observation: Observation,
        action: SetPointAction,
        config: EnvConfig,
        activation: str = "relu",
    ) -> PolicySpec:
        """The specification of a policy that is trained in environments of ``config``."""
        return cls(
            config.hand,
            tuple(hand.joint_names),
            tuple(hand.fingertip_names),
            observation.to_dict(),
            action.to_dict(),
            activation,
        )

    def check_hand(self, hand: HandModel) -> None:
        """Raise InvalidInput where ``hand`` is not the one that the policy is for."""
        own = (self.joint_names, self.fingertip_names)
        if own != (tuple(hand.joint_names), tuple(hand.fingertip_names)):
            raise InvalidInput(
                f"the policy is for the hand {self.hand!r} ({len(self.joint_names)} joints, "
                f"{len(self.fingertip_names)} fingers); got {hand.path.stem!r} ({hand.nq} joints, "
                f"{hand.n_fingers} fingers)"
            )

    def check_parts(self, parts: Sequence[str]) -> None:
        """Raise InvalidInput where the policy was trained with other observation parts."""
        trained = tuple(self.observation["parts"])
        if check_parts(parts) != trained:
            raise InvalidInput(
                f"the policy was trained with the observation parts {', '.join(trained)}; "
                f"got {', '.join(parts)}"
            )


@final
class Policy(Controller):
    """A trained policy, deterministic: tanh of a multilayer perceptron of the observation.

    It observes the state that it is given as it is, so that it runs on any plant.

    Args:
        hand: the hand, the same as in training.
        layers: the perceptron.
        spec: what the layers are for.
        card: what trained them.

    Attributes:
        spec, card: as given.
        observation, action: how observations and set-point changes are made.

    Raises:
        InvalidInput: the layers do not fit the observation, the hand or each other.
    """

    def __init__(
        self,
        hand: HandModel,
        layers: Sequence[Layer],
        spec: PolicySpec,
        card: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(hand, control_period=spec.action["control_period"])
        spec.check_hand(hand)
        if spec.activation not in ACTIVATIONS:
            raise UnknownName("activation", spec.activation, ACTIVATIONS)
        self.spec = spec
        self.card = dict(card or {})
        self.observation = Observation.from_dict(hand, spec.observation)
        self.action = SetPointAction(hand, **spec.action)
        self.layers = _checked(layers, self.observation.size, hand.nq)
        self._activation = ACTIVATIONS[spec.activation]

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        """Nothing to forget: the policy has no memory."""

    def predict(self, observation: ArrayLike) -> Floats:
        """The action ``(..., d)`` in [-1, 1] for observations ``(..., k)``."""
        x = np.asarray(observation, float)
        for i, layer in enumerate(self.layers):
            x = x @ layer.weight.T + layer.bias
            x = self._activation(x) if i + 1 < len(self.layers) else np.tanh(x)
        return x

    def act(self, state: GraspState) -> Floats:
        check_state(self.hand, state)
        action = self.predict(self.observation(state))
        self._diagnostics = {"action": action}
        return check_action(self.action.limited(state, self.action.to_change(action)))


def save_policy(
    path: str | Path,
    layers: Sequence[Layer | tuple[ArrayLike, ArrayLike]],
    spec: PolicySpec,
    card: Mapping[str, Any] | None = None,
) -> None:
    """Write a policy file and its card, each whole or not at all.

    Args:
        path: ends with ``.npz``; the card goes to the same name with ``.json``.
        layers: (weight ``(outputs, inputs)``, bias ``(outputs,)``) of each.
        spec: what they are for.
        card: what trained them: anything that JSON can hold (configuration, versions, seed, steps,
            figures).

    Raises:
        InvalidInput: another ending, or numbers that are not finite.
    """
    path = _npz(path)
    checked = _checked([Layer(np.asarray(w), np.asarray(b)) for w, b in layers])
    described = {
        "format": FORMAT,
        "dexctl": dexctl.__version__,
        "spec": spec._asdict(),
        "layers": [list(layer.weight.shape) for layer in checked],
        **(card or {}),
    }
    text = json.dumps(described, indent=2)
    arrays: dict[str, Any] = {}
    for i, layer in enumerate(checked):
        arrays |= {f"weight_{i}": layer.weight, f"bias_{i}": layer.bias}
    with aside(path) as part, part.open("wb") as stream:
        np.savez(stream, card=np.array(text), **arrays)
    write_text(path.with_suffix(".json"), text + "\n")


def load_policy(
    path: str | Path,
    *,
    hand: HandModel | str | None = None,
    parts: Sequence[str] | None = None,
) -> Policy:
    """Read a policy file.

    Args:
        path: the ``.npz`` file. Its card need not be beside it.
        hand: the hand to run it on; None loads the one that it was trained on.
        parts: refuse a policy that was trained with other observation parts than these.

    Raises:
        InvalidInput: no such file or no policy in it, another version of the format, another hand
            or other observation parts.
    """
    path = _npz(path)
    card, layers = _read(path)
    if card.get("format") != FORMAT:
        raise InvalidInput(
            f"policy {str(path)!r} has format {card.get('format')}; expected {FORMAT}"
        )
    try:
        values = card["spec"]
        spec = PolicySpec(
            values["hand"],
            tuple(values["joint_names"]),
            tuple(values["fingertip_names"]),
            values["observation"],
            values["action"],
            values["activation"],
        )
    except (KeyError, TypeError) as error:
        raise InvalidInput(f"policy {str(path)!r} lacks {error} in its card") from None
    if parts is not None:
        spec.check_parts(parts)
    name = spec.hand if hand is None else hand
    model = hands.load(name) if isinstance(name, str) else name
    return Policy(model, layers, spec, card)


def _read(path: Path) -> tuple[dict[str, Any], list[Layer]]:
    try:
        with np.load(path, allow_pickle=False) as stored:
            if "card" not in stored:
                raise ValueError("it holds no card")
            card = json.loads(str(stored["card"]))
            count = sum(name.startswith("weight_") for name in stored.files)
            layers = [Layer(stored[f"weight_{i}"], stored[f"bias_{i}"]) for i in range(count)]
    except FileNotFoundError:
        raise InvalidInput(f"policy {str(path)!r}: no such file") from None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InvalidInput(f"{str(path)!r} is not a policy file: {error}") from None
    return card, layers


def _npz(path: str | Path) -> Path:
    path = Path(path)
    if path.suffix != ".npz":
        raise InvalidInput(f"policy path is {str(path)!r}; expected one that ends with .npz")
    return path


def _checked(
    layers: Sequence[Layer], inputs: int | None = None, outputs: int | None = None
) -> tuple[Layer, ...]:
    """The layers, where they fit together and are finite."""
    if not layers:
        raise InvalidInput("the policy has no layers; expected at least one")
    width = layers[0].weight.shape[-1] if inputs is None else inputs
    for i, (weight, bias) in enumerate(layers):
        if weight.ndim != 2 or weight.shape[1] != width or bias.shape != (weight.shape[0],):
            raise InvalidInput(
                f"layer {i} of the policy has weight {weight.shape} and bias {bias.shape}; "
                f"expected (n, {width}) and (n,)"
            )
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise InvalidInput(f"layer {i} of the policy has numbers that are not finite")
        width = weight.shape[0]
    if outputs is not None and width != outputs:
        raise InvalidInput(f"the policy has {width} outputs; expected {outputs}, one for a joint")
    return tuple(layers)
