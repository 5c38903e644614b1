"""Policy: a trained policy as a controller that needs numpy only, and what it is for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexctl.controller import Controller, check_action, check_state
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.hand import HandModel
from dexctl.saved import batch_shape, check_names, fill
from dexctl.state import Floats, GraspState
from dexctl.symmetry import HandSymmetry, symmetries, turned_to
from dexctl.validation import (
    AXES,
    check_mask,
    check_vector,
    shown_numbers,
    unit_axis,
    unit_quaternion,
)
from learning.envs.action import SetPointAction
from learning.envs.history import History
from learning.envs.observation import (
    ANY,
    ATTITUDES,
    ORIENTATIONS,
    POSES,
    TURNING,
    Observation,
    check_parts,
)


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
        history: how many control steps ago the observations were that are observed beside the one
            of now, see `learning.envs.history`.
    """

    hand: str
    joint_names: tuple[str, ...]
    fingertip_names: tuple[str, ...]
    observation: Mapping[str, Any]
    action: Mapping[str, Any]
    activation: str = "relu"
    history: tuple[int, ...] = ()

    @classmethod
    def of(
        cls,
        hand: HandModel,
        observation: Observation,
        action: SetPointAction,
        name: str,
        activation: str = "relu",
        history: tuple[int, ...] = (),
    ) -> PolicySpec:
        """The specification of a policy that is trained with the hand of this name."""
        return cls(
            name,
            tuple(hand.joint_names),
            tuple(hand.fingertip_names),
            observation.to_dict(),
            action.to_dict(),
            activation,
            history,
        )

    def check_hand(self, hand: HandModel) -> None:
        """Raise InvalidInput where ``hand`` is not the one that the policy is for."""
        own = (self.joint_names, self.fingertip_names)
        if own != (tuple(hand.joint_names), tuple(hand.fingertip_names)):
            raise InvalidInput(
                f"the policy is for the hand {self.hand!r} ({len(self.joint_names)} joints, "
                f"{len(self.fingertip_names)} fingers); got {hand.name!r} ({hand.nq} joints, "
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

    def check_like(self, wanted: PolicySpec) -> None:
        """Raise InvalidInput where the policy observes or acts otherwise than ``wanted`` says."""
        own, other = (
            {**spec.observation, **spec.action, "activation": spec.activation,
             "history": tuple(spec.history)}
            for spec in (self, wanted)
        )  # fmt: skip
        for name in own:
            if own[name] != other[name]:
                raise InvalidInput(f"the policy has {name} {own[name]}; expected {other[name]}")


class Commanded(NamedTuple):
    """How objects were to turn in a training.

    Attributes:
        names: axes by name, or "any".
        speeds: lowest and highest [rad/s].
    """

    names: tuple[str, ...]
    speeds: tuple[float, float]

    @classmethod
    def of_card(cls, card: Mapping[str, Any]) -> Commanded | None:
        """What a card says of its training; None where it does not."""
        try:
            turning = card["trained"]["env"]["task"]["turning"]
            low, high = turning["command_speed_range"]
            return cls(tuple(turning["commands"]), (float(low), float(high)))
        except (LookupError, TypeError, ValueError):
            return None

    def knows(self, names: Sequence[str], speeds: tuple[float, float]) -> bool:
        """Whether these axes and speeds are among them."""
        return (ANY in self.names or set(names) <= set(self.names)) and self.fits(speeds)

    def fits(self, speeds: tuple[float, float]) -> bool:
        """Whether its speeds reach from the lower of these to the higher."""
        low, high = self.speeds
        return low * (1 - 1e-6) <= speeds[0] and speeds[1] <= high * (1 + 1e-6)

    def __str__(self) -> str:
        low, high = self.speeds
        fast = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        return f"commands {', '.join(self.names)} at {fast} rad/s"


def other_hand(policy: Policy) -> str | None:
    """What to know where a policy acts with another hand than it was trained with.

    None where it is the same to the last bit, or where the card does not say which it was.
    """
    trained = policy.card.get("hand")
    own = trained.get("sha256") if isinstance(trained, Mapping) else None
    if not isinstance(own, str) or own == policy.hand.digest:
        return None
    return (
        f"the policy was trained with the hand {policy.spec.hand} (sha256 {own[:12]}); this is "
        f"another: {policy.hand.name} (sha256 {policy.hand.digest[:12]})"
    )


def check_pace(pace: float) -> float:
    """The pace, once it is known to be one.

    Raises:
        InvalidInput: it is not.
    """
    number = isinstance(pace, (int, float, np.number)) and not isinstance(pace, bool)
    if not number or not 0.0 < pace <= 1.0:
        raise InvalidInput(f"pace is {pace!r}; expected a number above 0 and at most 1")
    return float(pace)


@final
class Policy(Controller):
    """A trained policy, deterministic: tanh of a multilayer perceptron of the observation.

    It observes the state that it is given as it is, so that it runs on any plant; and, where it was
    trained so, what it has observed some control steps before.

    Args:
        hand: the hand, the same as in training.
        layers: the perceptron.
        spec: what the layers are for.
        card: what trained them.
        goal: orientation that the object is wanted in, wxyz ``(4,)``, where a state tells none.
        angular_velocity: how the object is wanted to turn, ``(3,)`` [rad/s], where a state does not
            tell; for policies that can be told.
        symmetry: of the hand; the policy acts as in this image of the hand, so that one for z turns
            about -z. None: as it was trained.
        pace: share, above 0 and at most 1, of every set-point change that is made. Where contacts,
            not momentum, decide what the hand does, the policy then does what it did in more time.

    Attributes:
        spec, card, symmetry, pace: as given.
        observation, action: how observations and set-point changes are made.

    Raises:
        InvalidInput: the layers do not fit the observation, the hand or each other, the policy was
            not trained to be told what is wanted, or the pace is none.
    """

    def __init__(
        self,
        hand: HandModel,
        layers: Sequence[Layer],
        spec: PolicySpec,
        card: Mapping[str, Any] | None = None,
        *,
        goal: ArrayLike | None = None,
        angular_velocity: ArrayLike | None = None,
        symmetry: HandSymmetry | None = None,
        pace: float = 1.0,
    ) -> None:
        super().__init__(hand, control_period=spec.action["control_period"])
        spec.check_hand(hand)
        if spec.activation not in ACTIVATIONS:
            raise UnknownName("activation", spec.activation, ACTIVATIONS)
        self.spec = spec
        self.card = dict(card or {})
        self.observation = Observation.from_dict(hand, spec.observation)
        self.tracks = bool(set(POSES) & set(self.observation.parts))
        self.pose_age = _trained_age(self.card) if self.tracks else None
        self.action = SetPointAction(hand, **spec.action)
        self.history = History(self.observation.size, spec.history)
        self.layers = check_layers(layers, self.history.size, hand.nq)
        self.symmetry = symmetry
        self.pace = check_pace(pace)
        self._fresh = np.ones(0, bool)  # whose history begins with the next observation
        self._activation = ACTIVATIONS[spec.activation]
        self._wanted = {
            "goal_quaternion": None if goal is None else unit_quaternion("goal", goal),
            "goal_angular_velocity": (
                None
                if angular_velocity is None
                else check_vector("angular_velocity", angular_velocity, 3)
            ),
        }
        self._check_told("goal", goal, ORIENTATIONS)
        self._check_told("angular_velocity", angular_velocity, (TURNING,))

    def _check_told(self, what: str, value: ArrayLike | None, parts: tuple[str, ...]) -> None:
        if value is not None and not set(parts) & set(self.observation.parts):
            raise InvalidInput(
                f"{what} is {value}, and the policy, which observes "
                f"{', '.join(self.observation.parts)}, was not trained to be told; expected None"
            )

    @property
    def goes_to_goals(self) -> bool:
        """Whether it observes the state's ``goal_quaternion``: it acts only where there is one."""
        return bool(set(ORIENTATIONS) & set(self.observation.parts))

    @property
    def turns_as_told(self) -> bool:
        """Whether it observes a ``goal_angular_velocity``: it acts only where there is one."""
        return TURNING in self.observation.parts

    @property
    def commanded(self) -> Commanded | None:
        """What it was trained to be told; None where it is not told, or nobody knows."""
        return Commanded.of_card(self.card) if self.turns_as_told else None

    def other_commands(self, names: Sequence[str], speeds: tuple[float, float]) -> str | None:
        """What to know where it is told to turn as it was never told in training."""
        own = self.commanded
        if own is None or not names or own.knows(names, speeds):
            return None
        return (
            f"the policy was trained with {own}; this is {Commanded(tuple(names), speeds)}, which "
            "it may take for anything"
        )

    def check_told(self, angular_velocity: ArrayLike) -> None:
        """Raise InvalidInput where it was never told in training to turn so."""
        own, asked = self.commanded, np.asarray(angular_velocity, float)
        if own is None:
            return
        seen = asked if self.symmetry is None else self.symmetry.inverse.of_turnings(asked)
        speed = float(np.linalg.norm(seen))
        along = (np.dot(seen, AXES[name]) for name in own.names if name in AXES)
        known = ANY in own.names or any(speed - one <= 1e-6 * speed for one in along)
        if not known or not own.fits((speed, speed)):
            raise InvalidInput(
                f"angular_velocity is {shown_numbers(asked)} rad/s; the policy was trained with "
                f"{own}"
            )

    @property
    def axis(self) -> tuple[float, float, float] | None:
        """About which it turns an object, hand frame; None where it is told, or nobody knows."""
        own = _trained_axis(self.card, self.observation.parts)
        if own is None or self.symmetry is None:
            return own
        return unit_axis(self.symmetry.of_turnings(np.array(own)).round(9) + 0.0)

    def turned_to(self, axis: ArrayLike) -> Policy:
        """The same policy for turning about another axis, by a symmetry of the hand.

        One that is told what to turn about, or whose axis nobody knows, is as it was.

        Raises:
            InvalidInput: the hand has none that makes this axis of the policy's, or only a mirror
                image, and the policy sees the orientation of an object that has none.
        """
        own, wanted = _trained_axis(self.card, self.observation.parts), unit_axis(axis)
        if own is None or np.allclose(self.axis or own, wanted, atol=1e-6):
            return self
        symmetry = turned_to(self.hand, np.array(own), np.array(wanted))
        if symmetry is None:
            images = {
                shown_numbers(one.of_turnings(np.array(own)).round(3) + 0.0)
                for one in symmetries(self.hand)
            }
            raise InvalidInput(
                f"axis is {shown_numbers(wanted)}; the policy was trained to turn about "
                f"{shown_numbers(own)}, of which {self.hand.name!r}'s symmetries make "
                + ", ".join(sorted(images))
            )
        sees = not set(ATTITUDES).isdisjoint(self.observation.parts)
        twisted = _twisted(self.card) if symmetry.mirrors and sees else []
        if twisted:
            raise InvalidInput(
                f"axis is {shown_numbers(wanted)}; the policy sees how the {twisted[0]} lies, "
                f"which is not its own mirror image, expected {shown_numbers(own)}"
            )
        return Policy(
            self.hand, self.layers, self.spec, self.card, symmetry=symmetry, pace=self.pace,
            goal=self._wanted["goal_quaternion"],
            angular_velocity=self._wanted["goal_angular_velocity"],
        )  # fmt: skip

    def reset(self, seed: ArrayLike | None = None, mask: ArrayLike | None = None) -> None:
        """Forget what was observed before; a policy without a history has nothing to forget."""
        if mask is None or not len(self.history):
            self.history.clear()
        else:
            self._fresh |= check_mask(mask, self._fresh.shape)

    def state_dict(self) -> dict[str, Any]:
        if not self.history.steps:
            return self._signed()
        return self._signed(history={"seen": self.history.save(), "fresh": self._fresh.copy()})

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        if not self.history.steps:
            self._parts(saved)
            return
        own, kept = type(self).__name__, self._parts(saved, "history")["history"]
        check_names(own, kept, ("seen", "fresh"))
        (count,) = batch_shape(own, kept, "fresh") or (0,)
        fresh = np.zeros(count, bool)
        fill(own, {"fresh": fresh}, kept)
        if len(kept["seen"]) != count:
            raise InvalidInput(
                f"the saved state of {own} has {len(kept['seen'])} histories; expected {count}"
            )
        self.history.restore(kept["seen"])
        self._fresh = fresh

    def _seen(self, state: GraspState) -> NDArray[np.float32]:
        """What is observed, with what was; ``(..., k)``."""
        seen = self.observation(state)
        if not self.history.steps:
            return seen
        rows = seen.reshape(-1, self.observation.size)
        if not len(self.history):
            self._fresh = np.ones(len(rows), bool)
        elif len(rows) != len(self._fresh):
            raise InvalidInput(
                f"{len(self._fresh)} hands are remembered and the state has {len(rows)}; call "
                "reset() before the batch shape changes"
            )
        else:
            self.history.add(rows)
        self.history.begin(rows, self._fresh)
        self._fresh = np.zeros_like(self._fresh)
        return self.history.look().reshape(*state.batch_shape, -1)

    def predict(self, observation: ArrayLike) -> Floats:
        """The action ``(..., d)`` in [-1, 1] for observations ``(..., k)``, history and all."""
        x = np.asarray(observation, float)
        for i, layer in enumerate(self.layers):
            x = x @ layer.weight.T + layer.bias
            x = self._activation(x) if i + 1 < len(self.layers) else np.tanh(x)
        return x

    def act(self, state: GraspState) -> Floats:
        check_state(self.hand, state)
        told = {
            name: np.broadcast_to(value, (*state.batch_shape, len(value)))
            for name, value in self._wanted.items()
            if value is not None and getattr(state, name) is None
        }
        seen = replace(state, **told) if told else state
        if self.symmetry is None:
            action = self.predict(self._seen(seen))
        else:
            image = self.symmetry.inverse.of_state(seen)
            action = self.symmetry.of_joints(self.predict(self._seen(image)))
        self._diagnostics = {"action": action}
        change = self.pace * self.action.to_change(action)
        return check_action(self.action.limited(state, change))


def _trained_axis(
    card: Mapping[str, Any], parts: Sequence[str]
) -> tuple[float, float, float] | None:
    """The one axis that a policy's training was about; None: several, goals, or it does not say."""
    try:
        task = card["trained"]["env"]["task"]
        turning = task.get("turning", task)  # where older cards have it
        if TURNING not in parts:
            return None if set(parts) & set(ORIENTATIONS) else unit_axis(turning["axis"])
        (only,) = turning["commands"]
        return unit_axis(only)
    except (LookupError, TypeError, ValueError, AttributeError):
        return None


def _trained_age(card: Mapping[str, Any]) -> float | None:
    """How late the tracker of a policy's training was [s]; None: not at all, or it had none."""
    try:
        sensing = card["trained"]["env"]["scene"]["sensing"]
        late = float(sensing["tracker_latency"]) if sensing["object_pose"] == "tracked" else 0.0
    except (LookupError, TypeError, ValueError):
        return None
    return late if late > 0 else None


def _twisted(card: Mapping[str, Any]) -> list[str]:
    """The objects of a policy's training that are not their own mirror images."""
    from dexctl.sim.shapes import Shape

    try:
        scene = card["trained"]["env"]["scene"]
        return [
            name
            for name in scene["object"]
            if not Shape.of_object(name, 0.1, mesh=scene.get("object_mesh")).is_mirrored
        ]
    except (LookupError, TypeError, AttributeError):
        return []


def check_layers(
    layers: Sequence[Layer], inputs: int | None = None, outputs: int | None = None
) -> tuple[Layer, ...]:
    """The layers, where they are real, finite and fit together.

    Args:
        layers: from the first to the last.
        inputs, outputs: of all of them together; None is any number.

    Raises:
        InvalidInput: they do not.
    """
    if not layers:
        raise InvalidInput("the policy has no layers; expected at least one")
    width = inputs
    for i, (weight, bias) in enumerate(layers):
        if weight.dtype.kind != "f" or bias.dtype.kind != "f":
            raise InvalidInput(
                f"layer {i} of the policy has a weight of {weight.dtype} and a bias of "
                f"{bias.dtype}; expected floats"
            )
        if width is None and weight.ndim:
            width = weight.shape[-1]
        fits = weight.ndim == 2 and weight.shape[1] == width and bias.shape == weight.shape[:1]
        if not (fits and weight.size):
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
