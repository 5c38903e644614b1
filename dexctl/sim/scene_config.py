"""SceneConfig: which hand holds which object, and how it acts and senses.

Environments, evaluation, inspection, sweeps, the commands and the servo emulator all nest this one
configuration; `dexctl.sim.Simulation` is where its settings take effect.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from dexctl import hands
from dexctl.exceptions import InvalidInput, UnknownName
from dexctl.files import is_path
from dexctl.hand import HandModel
from dexctl.hand_config import HandConfig
from dexctl.limits import HandLimits
from dexctl.settings import FILE_OR_NAME, NESTED, Vector
from dexctl.sim.checks import gravity_vector
from dexctl.sim.grasp_states import states_file
from dexctl.sim.pushes import Push
from dexctl.sim.randomisation import Randomisation
from dexctl.sim.sensing import Sensing
from dexctl.validation import check_numbers, check_whole

if TYPE_CHECKING:
    from dexctl.sim.scene import Scene


# settings that are parameters of the simulator, and what it calls them
_PARAMETERS = {
    "object_friction": "friction",
    "stiffness": "kp",
    "damping": "kv",
    "gear_friction": "gear_friction",
}


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """A hand with an object, as it is simulated.

    Raises:
        UnknownName, InvalidInput: a setting is wrong; the message names it.
    """

    hand: Annotated[str, FILE_OR_NAME] = "dex5"
    """Name of the hand (`dexctl hands list` has them), or its file: a toml that `dexctl hands add`
    wrote, or an MJCF or URDF where what can be guessed from it suffices."""
    object: tuple[str, ...] = ("cube",)
    """Name of the object, or of several; the environments of a batch are shared out among them,
    and one that is named twice has twice the share."""
    object_size: float | None = None
    """Width of the object [m]; none: what suits the hand."""
    object_mass: float | None = None
    """Mass of the object [kg]; none: as the hand's toml has it, else 0.1."""
    object_friction: float | None = None
    """Sliding friction coefficient between object and fingertips; none: 1."""
    object_mesh: Path | None = None
    """STL or OBJ file of the object named mesh; its convex hull is what collides."""
    gravity: Vector = "up"
    """Which way the palm looks: up, down, or gravity as x,y,z [m/s^2]."""
    stiffness: float | None = None
    """Stiffness of the joints' servos [N m/rad]; none: as the hand's file has it."""
    damping: float | None = None
    """Damping of the joints' servos [N m s/rad]; none: as the hand's file has it."""
    gear_friction: float | None = None
    """Dry friction of the joints' gears [N m]; none: as the hand's file has it."""
    control_period: float = 0.05
    """Time of one control step [s]."""
    substeps: int = 10
    """Physics steps in a control step."""
    initial_states: Path | None = None
    """File of grasp states that episodes start from, or the folder of a tree; none: the settled
    grasp."""
    disturbance: float = 0.02
    """Standard deviation of the noise on the set-points at the start [rad]."""
    sensing: Annotated[Sensing, NESTED] = field(default_factory=Sensing)
    push: Annotated[Push, NESTED] = field(default_factory=Push)
    limits: Annotated[HandLimits, NESTED] = field(default_factory=HandLimits)
    randomisation: Annotated[Randomisation, NESTED] = field(default_factory=Randomisation)
    threads: int | None = None
    """How many threads step the physics; none: every core."""

    def __post_init__(self) -> None:
        if isinstance(self.object, str):
            object.__setattr__(self, "object", (self.object,))
        if isinstance(self.initial_states, (str, Path)):
            object.__setattr__(self, "initial_states", states_file(self.initial_states))
        hands.check(self.hand)
        if not self.object:
            raise InvalidInput("object is (); expected a name, or several")
        if not gravity_vector(self.gravity).any() and self.randomisation.draws_gravity:
            raise InvalidInput(
                f"gravity is {self.gravity}, and gravity_tilt or gravity_turning_range turns it; "
                "expected a gravity that is not zero with it"
            )
        check_numbers(
            self,
            positive=("control_period",),
            not_negative=("disturbance",),
            optional=("object_size", "object_mass", *_PARAMETERS),
        )
        check_whole(self, substeps=1)
        if self.threads is not None:
            check_whole(self, threads=1)

    @property
    def parameters(self) -> dict[str, float]:
        """Of the simulator, by its own names; what is not said stays as the files have it."""
        found = {name: getattr(self, setting) for setting, name in _PARAMETERS.items()}
        return {name: value for name, value in found.items() if value is not None}

    def with_mass(self, hand: HandConfig) -> SceneConfig:
        """The same with the object's mass said, for what is kept: the hand's toml may change."""
        mass = hand.object.mass if self.object_mass is None else self.object_mass
        return replace(self, object_mass=mass)

    def undisturbed(self) -> SceneConfig:
        """The same without noise, latency of the sensors, pushes, given starts and draws."""
        sensing = Sensing(
            touch=self.sensing.touch,
            joint_touch=self.sensing.joint_touch,
            object_pose=self.sensing.object_pose,
            touch_threshold=self.sensing.touch_threshold,
        )
        push = replace(self.push, push_force=0.0)
        return replace(
            self, sensing=sensing, push=push, initial_states=None, randomisation=Randomisation()
        )

    def check_objects(self, where: str = "") -> None:
        """Raise UnknownName where an object is not known; building nothing, it costs little.

        Args:
            where: whose objects these are, for the message.
        """
        from dexctl.sim.objects import MESH, object_names

        for name in self.object:
            if name not in (*object_names(), MESH):
                raise UnknownName(f"object in {where}" if where else "object", name, object_names())

    def scenes(self, hand: HandModel | None = None) -> list[Scene]:
        """The scene of each object.

        Args:
            hand: in place of loading the one that is named.

        Raises:
            UnknownName: no such object.
            SimulationError: the hand does not hold the object.
        """
        from dexctl.sim.parameters import set_on
        from dexctl.sim.scene import Scene

        self.check_objects()
        model = hands.load(self.hand) if hand is None else hand
        found = [
            Scene.build(
                model,
                name,
                self.gravity,
                object_mass=self.object_mass,
                object_size=self.object_size,
                object_mesh=self.object_mesh,
            )
            for name in self.object
        ]
        for scene in found:  # before they settle
            set_on(scene, self.parameters)
        return found

    @property
    def hand_name(self) -> str:
        """The hand, for people."""
        return Path(self.hand).stem if is_path(self.hand) else self.hand

    @property
    def palm(self) -> str:
        """How the hand is held, for people."""
        if isinstance(self.gravity, str):
            return f"palm {self.gravity}"
        return f"gravity ({', '.join(f'{number:g}' for number in self.gravity)}) m/s²"
