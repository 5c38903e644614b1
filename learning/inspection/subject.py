"""What is inspected: a run, a policy file, or a controller in the policy's place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dexctl import controllers, hands
from dexctl.controller import Controller
from dexctl.exceptions import InvalidInput
from learning.policies import Policy, load_policy
from learning.training.run_folder import RunFolder

if TYPE_CHECKING:
    from learning.inspection.critic import Critic
    from learning.settings import TrainConfig

SHADOWS = ("igm", "gait", "coordinated")
"""Controllers in shadow where nothing says which guided the training."""


@dataclass(frozen=True, eq=False)
class Subject:
    """What is inspected.

    Attributes:
        name: as given.
        kind: "run", "policy" or "controller".
        controller: who acts.
        folder: of the run; None for the others.
        config: of the run; None for the others.
        critic: of the run's checkpoint; None without one.
        remarks: what the reader should know.
    """

    name: str
    kind: str
    controller: Controller
    folder: Path | None = None
    config: TrainConfig | None = None
    critic: Critic | None = None
    remarks: tuple[str, ...] = ()

    @property
    def trained(self) -> dict[str, Any]:
        """The configuration that trained it; {} for a controller or where the card has none."""
        card = self.controller.card if isinstance(self.controller, Policy) else {}
        found = card.get("trained", {})
        return found if isinstance(found, dict) else {}

    @property
    def objects(self) -> tuple[str, ...]:
        """What it was trained with; empty for a controller or where nobody knows."""
        found = self.trained.get("env", {}).get("object", ())
        return (found,) if isinstance(found, str) else tuple(found)

    @property
    def guides(self) -> tuple[str, ...]:
        """Names of the controllers that guided the training; empty without."""
        method = self.trained.get("guidance", {}).get("method", "rl")
        return () if method == "rl" else tuple(self.trained.get("controllers", ()))

    @property
    def shadows(self) -> tuple[str, ...]:
        """The controllers to compare with, where nobody says which: its guides, or some others."""
        return self.guides or tuple(name for name in SHADOWS if name != self.name)

    @property
    def horizon(self) -> int | None:
        """H of the training, where one was set [steps]."""
        return self.trained.get("guidance", {}).get("horizon")


def open_subject(name: str, hand: str | None = None) -> Subject:
    """What ``name`` names.

    Args:
        name: a run folder, a policy file (.npz), or a controller.
        hand: name of the hand; None is the policy's own, dex5 for a controller.

    Raises:
        InvalidInput: it is none of these, or a policy for another hand.
        CheckpointError: the run's checkpoint is damaged, or of another version.
        MissingExtra: a run needs torch, for its critic.
    """
    path = Path(name).expanduser()
    if path.is_dir():
        return _open_run(name, path, hand)
    if path.suffix == ".npz":
        remark = "A policy file has no critic: p_psi needs the run folder, with its checkpoint."
        return Subject(name, "policy", policies.load(path, hand=hand), remarks=(remark,))
    if name in controllers.names():
        made = controllers.make(name, hands.load(hand or "dex5"))
        remark = "A controller has no critic, so there is no p_psi."
        return Subject(name, "controller", made, remarks=(remark,))
    what = "no run, policy or controller" if path.exists() else "not there, and no controller"
    raise InvalidInput(
        f"{name!r} is {what}; expected a run folder, a policy file (.npz), or one of "
        f"{', '.join(controllers.names())}"
    )


def _open_run(name: str, folder: Path, hand: str | None) -> Subject:
    run = RunFolder(folder)
    if not run.config_path.exists():
        raise InvalidInput(f"{name!r} is no run folder: there is no {run.config_path.name} in it")
    if not run.policy_path.exists():
        raise InvalidInput(
            f"the run {name!r} has no {run.policy_path.name} yet; "
            "it comes with the first checkpoint"
        )
    from learning.inspection.training import read_config

    config = read_config(folder)
    policy = load_policy(run.policy_path, hand=hand)
    remarks: tuple[str, ...] = ()
    critic = None
    if not run.checkpoint_path.exists():
        remarks = (
            f"The run has no {run.checkpoint_path.name}, so there is no critic and no p_psi.",
        )
    else:
        from importlib.util import find_spec

        from dexctl.exceptions import MissingExtra

        if find_spec("torch") is None or find_spec("stable_baselines3") is None:
            raise MissingExtra("the critic of a run (its policy.npz can do without)", "learning")
        from learning.inspection.critic import Critic

        critic = Critic(folder, config)
    return Subject(name, "run", policy, folder, config, critic, remarks)
