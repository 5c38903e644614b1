"""The stable-grasp checks: static from contacts, dynamic on plants whose motion is known."""

from __future__ import annotations

import numpy as np
import pytest

from dexctl import GraspState
from dexctl.exceptions import InvalidInput
from dexctl.grasp import check_stable, check_static


class Sliding:
    """A plant whose object moves at a constant velocity and turns at a constant rate about z."""

    control_period = 0.05

    diverged = np.asarray(False)

    def __init__(
        self, velocity, spin: float | list[float] = 0.0, touching=3, tracked=True, oriented=True
    ):
        self.velocity = np.asarray(velocity, float)
        self.spin = np.broadcast_to(np.asarray(spin, float), self.velocity.shape[:-1])
        self.touching, self.tracked, self.oriented = touching, tracked, oriented
        self.time, self.written = 0.0, []

    def read(self):
        batch = self.velocity.shape[:-1]
        angle = self.spin * self.time
        zero = np.zeros(batch)
        quaternion = np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], axis=-1)
        return GraspState(
            q=np.zeros((*batch, 2)), q_target=np.full((*batch, 2), 0.3),
            in_contact=np.broadcast_to(np.arange(3) < self.touching, (*batch, 3)),
            contact_position=np.zeros((*batch, 3, 3)), contact_normal=np.zeros((*batch, 3, 3)),
            contact_force=np.zeros((*batch, 3)),
            object_position=0.1 + self.velocity * self.time if self.tracked else None,
            object_quaternion=quaternion if self.oriented else None,
        )  # fmt: skip

    def write(self, q_target):
        self.written.append(q_target)
        return q_target

    def step(self):
        self.time += self.control_period


class Restoring(Sliding):
    def save(self):
        return self.time

    def restore(self, saved):
        self.time = saved


def test_one_hand_that_holds_and_one_that_drops():
    holds = check_stable(Sliding([0.0, 0, -0.02]))
    assert holds.stable and holds.stable.shape == ()
    assert holds.displacement == pytest.approx(0.04)
    assert holds.held == pytest.approx(2.0)
    assert holds.contacts == 3
    drops = check_stable(Sliding([0.0, 0, -0.1]))
    assert not drops.stable
    assert drops.displacement == pytest.approx(0.2)
    assert drops.held == pytest.approx(0.5, abs=0.051)


def test_many_at_once_and_the_set_points_are_held():
    plant = Sliding([[0.0, 0, 0], [0.03, 0, 0], [np.nan, 0, 0]], spin=[0.0, 0.2, 0.0])
    got = check_stable(plant, 1.0, max_distance=0.02)
    np.testing.assert_array_equal(got.stable, [True, False, False])
    np.testing.assert_allclose(got.rotation, [0, 0.2, 0], atol=1e-12)
    assert len(plant.written) == 20
    assert all((target == 0.3).all() for target in plant.written)


def test_rotation_and_contacts_count_where_asked():
    plant = Sliding([0.0, 0, 0], spin=0.5, touching=2)
    assert check_stable(plant).stable
    assert not check_stable(plant, max_rotation=0.9).stable
    assert check_stable(plant, max_rotation=1.1).stable
    assert not check_stable(plant, min_contacts=3).stable


def test_a_plant_that_can_is_left_as_it_was():
    plant = Restoring([0.0, 0, 0])
    plant.time = 0.7
    check_stable(plant)
    assert plant.time == 0.7
    check_stable(plant, restore=False)
    assert plant.time == pytest.approx(2.7)


def test_a_failure_on_the_way_restores_too():
    class Broken(Restoring):
        def step(self):
            super().step()
            if self.time > 0.5:
                raise RuntimeError("the wire came off")

    plant = Broken([0.0, 0, 0])
    with pytest.raises(RuntimeError, match="wire"):
        check_stable(plant)
    assert plant.time == 0.0


def test_diverged_environments_are_unstable():
    plant = Sliding(np.zeros((2, 3)))
    plant.diverged = np.array([False, True])
    np.testing.assert_array_equal(check_stable(plant).stable, [True, False])


@pytest.mark.parametrize(
    ("plant", "options", "message"),
    [
        (Sliding([0.0, 0, 0], tracked=False), {}, "object_position is None"),
        (Sliding([0.0, 0, 0], oriented=False), dict(max_rotation=1.0), "object_quaternion"),
        (Sliding([0.0, 0, 0]), dict(seconds=0.0), "seconds"),
        (Sliding([0.0, 0, 0]), dict(seconds=np.inf), "seconds"),
        (Sliding([0.0, 0, 0]), dict(max_distance=np.nan), "max_distance"),
        (Sliding([0.0, 0, 0]), dict(max_rotation=-1.0), "max_rotation"),
    ],
)
def test_bad_arguments_are_named(plant, options, message):
    with pytest.raises(InvalidInput, match=message):
        check_stable(plant, **options)


def test_static_check():
    angle = 2 * np.pi * np.arange(4) / 4
    position = 0.05 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    normal, origin = -position / 0.05, np.zeros(3)
    weight = [0, 0, -1.0, 0, 0, 0]
    good = check_static(position, normal, np.ones(4, bool), origin, 0.6, external_wrench=weight)
    assert good.stable and good.closure and good.contacts == 4
    assert good.forces is not None and good.forces.feasible
    weak = check_static(
        position, normal, np.ones(4, bool), origin, 0.6, external_wrench=weight, max_normal=0.1
    )
    assert weak.closure and not weak.stable
    # a soft pinch closes with two contacts, which is too few unless allowed
    pinch = (position, normal, [1, 0, 1, 0], origin, 0.6)
    assert not check_static(*pinch, model="soft").stable
    assert check_static(*pinch, model="soft", min_contacts=2).stable
    many = check_static(
        np.stack([position] * 2), np.stack([normal] * 2), [[1, 1, 1, 1], [1, 1, 0, 0]], origin, 0.6
    )
    np.testing.assert_array_equal(many.stable, [True, False])
    with pytest.raises(InvalidInput, match="external_wrench"):
        check_static(*pinch, max_normal=1.0)
