"""Perceptrons of one shape in a batch: twin critics are two, an actor is one.

On a processor they are passed through by hand, forth and back, instead of by autograd: nothing
is differentiated that nobody asks for (the critics' weights where the actor learns, the observation
ever), and products are oneDNN's. torch multiplies float32 matrices with MKL, which on processors of
AMD takes the narrow half of the vector unit: a hidden layer takes 0.65 ms with it and 0.31 ms with
oneDNN (512 rows, 256 to 256, one thread). On a GPU both are one batched product, left to autograd.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise
from math import prod
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
        flat: all weights in one vector, so that an optimiser and a target take one call each.
        weights, biases: of each layer, ``(C, outputs, inputs)`` and ``(C, outputs)``; views.
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
        self._allocate(device)
        for values, inputs in zip(self.weights + self.biases, 2 * self.widths[:-1], strict=True):
            drawn = torch.rand(values.shape, generator=generator, device=device)
            values.copy_((2.0 * drawn - 1.0) / inputs**0.5)
        for values in self.scales:
            values.fill_(1.0)
        self.flat.requires_grad_()

    def _allocate(self, device: Any) -> None:
        pairs = list(pairwise(self.widths))
        hidden = self.widths[1:-1] if self.layer_norm else ()
        shapes = [(self.count, o, i) for i, o in pairs] + [(self.count, o) for _, o in pairs]
        shapes += 2 * [(self.count, width) for width in hidden]
        # each begins where vector registers load fastest
        sizes = [-(-prod(shape) // 16) * 16 for shape in shapes]
        starts = [0, *accumulate(sizes)]
        n, m = len(pairs), len(hidden)
        edges = (0, n, 2 * n, 2 * n + m, 2 * n + 2 * m)
        self._layout = _Layout(list(zip(starts, shapes, strict=False)), list(pairwise(edges)))
        self.flat = torch.zeros(starts[-1], device=device)
        self.weights, self.biases, self.scales, self.shifts = self._layout.split(self.flat)

    def copy(self) -> Perceptrons:
        """Others with the same weights, which no optimiser changes."""
        made = Perceptrons.__new__(Perceptrons)
        made.count, made.widths, made.layer_norm = self.count, self.widths, self.layer_norm
        made._allocate(self.flat.device)
        made.flat.copy_(self.flat.detach())
        return made

    def follow(self, source: Perceptrons, tau: float) -> None:
        """``self += tau (source - self)``."""
        with torch.no_grad():
            self.flat.lerp_(source.flat, tau)

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
        flat = self.flat.detach() if frozen else self.flat
        count = 1 if first else self.count
        if plain or observation.device.type != "cpu":
            return self._plain(observation, action, flat, count)
        inputs = observation if action is None else torch.cat([observation, action.detach()], dim=1)
        inputs = inputs.contiguous()
        if not torch.is_grad_enabled():
            return _forth(inputs, self, count)[0]
        return _Pass.apply(inputs, action, flat, self, count)

    def _plain(
        self,
        observation: torch.Tensor,
        action: torch.Tensor | None,
        flat: torch.Tensor,
        count: int,
    ) -> torch.Tensor:
        inputs = observation if action is None else torch.cat([observation, action], dim=1)
        found = inputs.expand(count, *inputs.shape)
        weights, biases, scales, shifts = self._layout.split(flat)
        for k, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            found = torch.baddbmm(bias[:count, None], found, weight[:count].transpose(1, 2))
            if k < len(weights) - 1:
                if self.layer_norm:
                    found = functional.layer_norm(found, (found.shape[-1],), eps=EPSILON)
                    found = found * scales[k][:count, None] + shifts[k][:count, None]
                found = functional.relu(found)
        return found


class _Layout(NamedTuple):
    """Where in a vector the pieces (start, shape) are, and which of them belong together."""

    pieces: list[tuple[int, tuple[int, ...]]]
    groups: list[tuple[int, int]]

    def split(self, flat: torch.Tensor) -> list[list[torch.Tensor]]:
        """Views: weights, biases, scales and shifts."""
        views = [flat[start : start + prod(shape)].view(shape) for start, shape in self.pieces]
        return [views[a:b] for a, b in self.groups]


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
    inputs: torch.Tensor, net: Perceptrons, count: int
) -> tuple[torch.Tensor, list[list[Any]]]:
    """The values, and for each perceptron and layer what the way back needs."""
    weights, biases, scales, shifts = net.weights, net.biases, net.scales, net.shifts
    values, kept = [], []
    for c in range(count):
        found, path = inputs, []
        for k in range(len(weights) - 1):
            if net.layer_norm:
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
        flat: torch.Tensor,
        net: Perceptrons,
        count: int,
    ) -> torch.Tensor:
        values, ctx.kept = _forth(inputs, net, count)
        ctx.net, ctx.width = net, 0 if action is None else action.shape[1]
        return values

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[Any, ...]:
        net: Perceptrons = ctx.net
        learns, by_action = ctx.needs_input_grad[2], None
        # what `first` leaves out has no gradient, nor have the gaps between the pieces
        flat = torch.zeros_like(net.flat) if learns else None
        pieces = [[], [], [], []] if flat is None else net._layout.split(flat)
        by_weight, by_bias, by_scale, by_shift = pieces
        values = grads[0].contiguous()
        for c, path in enumerate(ctx.kept):
            back = values[c]
            for k in range(len(path) - 1, -1, -1):
                given = path[k][0]
                if learns:
                    by_weight[k][c] = product(back.t(), given.t())
                    torch.sum(back, dim=0, out=by_bias[k][c])
                if k == 0:
                    break
                back = product(back, net.weights[k][c].t())
                back = torch.ops.aten.threshold_backward(back, given, 0.0)
                if net.layer_norm:
                    _, bare, mean, deviation = path[k - 1]
                    back, scale, shift = torch.ops.aten.native_layer_norm_backward(
                        back, bare, bare.shape[1:], mean, deviation,
                        net.scales[k - 1][c], net.shifts[k - 1][c], (True, learns, learns),
                    )  # fmt: skip
                    if learns:
                        by_scale[k - 1][c], by_shift[k - 1][c] = scale, shift
            if ctx.needs_input_grad[1]:
                columns = net.weights[0][c][:, -ctx.width :].contiguous()
                one = product(back, columns.t())
                by_action = one if by_action is None else by_action.add_(one)
        return None, by_action, flat, None, None
