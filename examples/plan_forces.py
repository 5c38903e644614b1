"""For grasp planners: does this grasp hold, how well, and with which forces?"""

from __future__ import annotations

import numpy as np

from dexctl import grasp


def main() -> None:
    # Three fingertips on the rim of a 0.1 m disc, 120 degrees apart; normals point inwards.
    angle = np.deg2rad([90.0, 210.0, 330.0])
    outward = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(3)])
    position, normal = 0.05 * outward, -outward
    touch, origin, friction = np.ones(3, bool), np.zeros(3), 0.6

    print("force closure:", bool(grasp.is_force_closure(position, normal, touch, origin, friction)))
    print(f"epsilon: {grasp.epsilon_quality(position, normal, touch, origin, friction):.3f}")
    balance = grasp.stability_forces(position, normal, touch, origin)
    print(f"forces in balance: {balance.forces.round(3)}, residual {balance.residual:.1e}")

    weight = np.array([0, 0, -0.2 * 9.81, 0, 0, 0])  # 0.2 kg: force [N], torque [N m]
    held = grasp.grasp_forces(position, normal, touch, origin, friction, weight)
    print(f"to hold 0.2 kg: {held.normal.round(2)} N along the normals, feasible: {held.feasible}")
    heavy = grasp.grasp_forces(
        position, normal, touch, origin, friction, 20 * weight, max_normal=10.0
    )
    print(f"to hold 4 kg with 10 N each: {heavy.violation:.1f} N are missing")


if __name__ == "__main__":
    main()
