"""The mesh files that a URDF names."""

from __future__ import annotations

from pathlib import Path

import mujoco

from dexctl.description.geometry import mesh_places

_MESHES = (".obj", ".stl", ".msh")  # what MuJoCo reads


def find_mesh(urdf: Path, name: str) -> tuple[Path | None, str]:
    """Where a mesh of a URDF is, and why it is not to be had.

    In the place of a file of another format, one of the same name that MuJoCo can read is as good.
    """
    places = mesh_places(urdf, name)
    for place in places:
        for suffix in dict.fromkeys((place.suffix, *_MESHES)):
            found = place.with_suffix(suffix)
            if suffix.lower() in _MESHES and found.is_file():
                why = _unreadable(found)
                return (None, why) if why else (found, "")
    there = next((place for place in places if place.is_file()), None)
    if there is not None:
        return None, f"MuJoCo reads {', '.join(_MESHES)}; convert it, and lay it beside {there}"
    more = len(places) - 1
    return None, f"not found; looked for {places[0]}" + (f" and {more} more places" if more else "")


def _unreadable(file: Path) -> str:
    """Why MuJoCo cannot read a mesh; empty where it can."""
    spec = mujoco.MjSpec()
    spec.add_mesh(name="m", file=str(file), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="m")
    try:
        spec.compile()
    except ValueError as error:
        return "MuJoCo cannot read it: " + " ".join(str(error).split())
    return ""
