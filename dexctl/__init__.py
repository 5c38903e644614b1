"""Controllers for multi-fingered robot hands."""
from dexctl import hands
from dexctl.hand import HandModel
from dexctl.state import GraspState
