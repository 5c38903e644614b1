"""Perceptrons of one shape in a batch: twin critics are two, an actor is one.

On a processor they are passed through by hand, forth and back, instead of by autograd: nothing
is differentiated that nobody asks for (the critics' weights where the actor learns, the observation
ever), and products are oneDNN's. torch multiplies float32 matrices with MKL, which on processors of
AMD takes the narrow half of the vector unit: a hidden layer takes 0.65 ms with it and 0.31 ms with
oneDNN (512 rows, 256 to 256, one thread). On a GPU both are one batched product, left to autograd.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch.nn import functional

_ONEDNN: Any = None
if torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise"):
    _ONEDNN = torch.ops.mkldnn._linear_pointwise.default
EPSILON = 1e-5  # of layer normalisation, torch's


class Perceptrons:
    """C multilayer perceptrons with a ReLU after each layer but the last.

    Weights begin as those of `torch.nn.Linear`, uniform within 1 / sqrt(inputs).

    Args:
        count: C.
        widths: of the input, the hidden layers and the output.
        layer_norm: normalise each hidden layer before its ReLU (Ball et al. 2023, "Efficient
            online reinforcement learning with offline data": it bounds what critics extrapolate
            to actions that nobody tried).
        generator: of the first weights.
        device: where they are.

    Attributes:
        weights, biases: of each layer, ``(C, outputs, inputs)`` and ``(C, outputs)``.
        scales, shifts: of each hidden layer's normalisation, ``(C, width)``; empty without.
    """

    def __init__(
        self,
        count: int,
        widths: Sequence[int],
        *,
        layer_norm: bool = False,
        generator: torch.Generator,
        device: str = "cpu",
    ) -> None:
        self.count, self.widths, self.layer_norm = count, tuple(widths), layer_norm

        def uniform(inputs: int, *shape: int) -> torch.Tensor:
            drawn = 2.0 * torch.rand(count, *shape, generator=generator, device=device) - 1.0
            return (drawn / inputs**0.5).requires_grad_()

        def constant(value: float, width: int) -> torch.Tensor:
            return torch.full((count, width), value, device=device).requires_grad_()

        self.weights = [uniform(i, o, i) for i, o in pairwise(widths)]
        self.biases = [uniform(i, o) for i, o in pairwise(widths)]
        hidden = widths[1:-1] if layer_norm else ()
        self.scales = [constant(1.0, width) for width in hidden]
        self.shifts = [constant(0.0, width) for width in hidden]

    @property
    def parameters(self) -> list[torch.Tensor]:
        """All weights, in one order."""
        return [*self.weights, *self.biases, *self.scales, *self.shifts]

    def copy(self) -> Perceptrons:
        """Others with the same weights, which no optimiser changes."""
        made = Perceptrons.__new__(Perceptrons)
        made.count, made.widths, made.layer_norm = self.count, self.widths, self.layer_norm
        for name in ("weights", "biases", "scales", "shifts"):
            setattr(made, name, [p.detach().clone() for p in getattr(self, name)])
        return made

    def follow(self, source: Perceptrons, tau: float) -> None:
        """``self += tau (source - self)``."""
        with torch.no_grad():
            torch._foreach_lerp_(self.parameters, source.parameters, tau)  # pyright: ignore[reportPrivateImportUsage]

    def __call__(
        self,
        observation: torch.Tensor,
        action: torch.Tensor | None = None,
        *,
        frozen: bool = False,
        first: bool = False,
        plain: bool = False,
    ) -> torch.Tensor:
        """What all of them make of the same input, ``(C, B, outputs)``.

        Args:
            observation: ``(B, k)``; never differentiated.
            action: further columns ``(B, d)``, differentiated where they require it.
            frozen: whether the weights get no gradient.
            first: whether to ask the first of them only, ``(1, B, outputs)``.
            plain: whether autograd does it all, which gives the same but for rounding.
        """
        weights = [p.detach() for p in self.parameters] if frozen else self.parameters
        if first:
            weights = [p[:1] for p in weights]
        if plain or observation.device.type != "cpu":
            return self._plain(observation, action, weights)
        inputs = observation if action is None else torch.cat([observation, action.detach()], dim=1)
        shape = _Shape(len(self.weights), self.layer_norm)
        inputs = inputs.contiguous()
        if not torch.is_grad_enabled():
            return _forth(inputs, weights, shape)[0]
        return _Pass.apply(inputs, action, shape, *weights)

    def _plain(
        self, observation: torch.Tensor, action: torch.Tensor | None, parameters: Any
    ) -> torch.Tensor:
        inputs = observation if action is None else torch.cat([observation, action], dim=1)
        found = inputs.expand(len(parameters[0]), *inputs.shape)
        weights, biases, scales, shifts = _split(parameters, len(self.weights))
        for k, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            found = torch.baddbmm(bias[:, None], found, weight.transpose(1, 2))
            if k < len(weights) - 1:
                if self.layer_norm:
                    found = functional.layer_norm(found, (found.shape[-1],), eps=EPSILON)
                    found = found * scales[k][:, None] + shifts[k][:, None]
                found = functional.relu(found)
        return found


class _Shape(NamedTuple):
    layers: int
    layer_norm: bool


def _split(parameters: Sequence[Any], n: int) -> tuple[Sequence[Any], ...]:
    """Weights, biases, scales and shifts, of `Perceptrons.parameters` for n layers."""
    edges = (0, n, 2 * n, 3 * n - 1, 4 * n - 2)
    return tuple(parameters[a:b] for a, b in pairwise(edges))


def product(
    a: torch.Tensor, b: torch.Tensor, bias: torch.Tensor | None = None, relu: bool = False
) -> torch.Tensor:
    """``a b^T + bias`` of matrices that are contiguous or transposes of such ones."""
    # oneDNN compiles for each shape, so those that hardly recur (the states in which a choice is
    # due) are MKL's; small ones are too, where asking costs more than is gained
    rows, inner = a.shape
    if _ONEDNN is not None and rows * inner * len(b) >= 1 << 19 and rows % 16 == 0:
        return _ONEDNN(a, b, bias, "relu" if relu else "none", [], "")
    found = a @ b.t() if bias is None else torch.addmm(bias, a, b.t())
    return found.relu_() if relu else found


def _forth(
    inputs: torch.Tensor, parameters: Sequence[torch.Tensor], shape: _Shape
) -> tuple[torch.Tensor, list[Any]]:
    """The values, and for each perceptron and layer what the way back needs."""
    weights, biases, scales, shifts = _split([p.unbind() for p in parameters], shape.layers)
    values, kept = [], []
    for c in range(len(weights[0])):
        found, path = inputs, []
        for k in range(shape.layers - 1):
            if shape.layer_norm:
                bare = product(found, weights[k][c], biases[k][c])
                normal, mean, deviation = torch.native_layer_norm(
                    bare, bare.shape[1:], scales[k][c], shifts[k][c], EPSILON
                )
                path.append((found, bare, mean, deviation))
                found = normal.relu_()
            else:
                path.append((found,))
                found = product(found, weights[k][c], biases[k][c], relu=True)
        path.append((found,))
        kept.append(path)
        values.append(product(found, weights[-1][c], biases[-1][c]))
    return torch.stack(values), kept


class _Pass(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        inputs: torch.Tensor,
        action: torch.Tensor | None,
        shape: _Shape,
        *parameters: torch.Tensor,
    ) -> torch.Tensor:
        values, ctx.kept = _forth(inputs, parameters, shape)
        ctx.shape, ctx.parameters = shape, parameters
        ctx.width = 0 if action is None else action.shape[1]
        return values

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[Any, ...]:
        n, learns = ctx.shape.layers, any(ctx.needs_input_grad[3:])
        weights, _, scales, shifts = _split(ctx.parameters, n)
        found = [torch.empty_like(p) for p in ctx.parameters] if learns else []
        by_weight, by_bias, by_scale, by_shift = _split(found, n)
        by_action = None
        values = grads[0].contiguous()
        for c, path in enumerate(ctx.kept):
            back = values[c]
            for k in range(n - 1, -1, -1):
                given = path[k][0]
                if learns:
                    by_weight[k][c] = product(back.t(), given.t())
                    torch.sum(back, dim=0, out=by_bias[k][c])
                if k == 0:
                    break
                back = product(back, weights[k][c].t())
                back = torch.ops.aten.threshold_backward(back, given, 0.0)
                if ctx.shape.layer_norm:
                    _, bare, mean, deviation = path[k - 1]
                    back, scale, shift = torch.ops.aten.native_layer_norm_backward(
                        back, bare, bare.shape[1:], mean, deviation,
                        scales[k - 1][c], shifts[k - 1][c], (True, learns, learns),
                    )  # fmt: skip
                    if learns:
                        by_scale[k - 1][c], by_shift[k - 1][c] = scale, shift
            if ctx.needs_input_grad[1]:
                columns = weights[0][c][:, -ctx.width :].contiguous()
                one = product(back, columns.t())
                by_action = one if by_action is None else by_action.add_(one)
        return None, by_action, None, *(found if learns else [None] * len(ctx.parameters))
