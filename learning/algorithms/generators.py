"""The states of torch's random generators, on whichever device they draw."""

from __future__ import annotations

from zlib import crc32

import torch


def restore_generator(generator: torch.Generator, saved: torch.Tensor) -> None:
    """Give a generator the state that its ``get_state`` gave, or that of one of another device.

    Processors and GPUs draw from different generators, so one cannot go on with the state of the
    other: where a run changes its device it draws other numbers from there on, the same ones
    whenever it is resumed from the same checkpoint.
    """
    if saved.shape == generator.get_state().shape:
        generator.set_state(saved)
    else:
        generator.manual_seed(crc32(saved.numpy().tobytes()))
