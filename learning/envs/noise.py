"""Sensor noise: what a policy observes of a state that controllers see as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dexctl.state import Bools, GraspState
from dexctl.streams import Streams
from learning.envs.config import EnvConfig


def observed(
    state: GraspState, config: EnvConfig, streams: Streams, mask: Bools | None = None
) -> GraspState:
    """``state`` ``(N,)`` with the noise of ``config`` on joints and touch.

    Joint positions and contact points get additive noise, normals additive noise before they are
    made unit again, forces noise in proportion. Set-points are known exactly. Each environment has
    its own random stream; only those in ``mask`` move on.
    """
    if not config.noisy:
        return state
    count, d = state.q.shape
    m = state.in_contact.shape[1]
    noise = streams.normal((d + 7 * m,), mask)
    joints, fingers = noise[:, :d], noise[:, d:].reshape(count, m, 7)
    touch = state.in_contact[..., None]
    normal = state.contact_normal + config.normal_noise * fingers[..., 3:6]
    length = np.sqrt((normal * normal).sum(axis=-1, keepdims=True))
    normal = normal / np.maximum(length, 1e-12)
    position = state.contact_position + config.position_noise * fingers[..., :3]
    force = state.contact_force * np.maximum(1.0 + config.force_noise * fingers[..., 6], 0.0)
    return replace(
        state,
        q=state.q + config.joint_noise * joints,
        contact_position=np.where(touch, position, 0.0),
        contact_normal=np.where(touch, normal, 0.0),
        contact_force=force,
    )
