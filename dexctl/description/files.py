"""Which files a description is made of."""

from __future__ import annotations

from pathlib import Path

from dexctl.description.geometry import find_mesh
from dexctl.description.xml_text import parse_xml
from dexctl.exceptions import HandModelError


def files_of(path: Path) -> list[Path]:
    """The description file, what it includes, and the meshes that are found, each once."""
    found: dict[Path, None] = {path: None}
    meshes: list[str] = []
    folders = [path.parent]
    waiting = [path]
    while waiting:
        file = waiting.pop(0)
        try:
            root = parse_xml(file)
        except HandModelError:  # MuJoCo's own reader takes more
            continue
        for element in root.iter():
            if element.tag == "compiler":
                named = (element.get("meshdir"), element.get("assetdir"))
                folders += [path.parent / folder for folder in named if folder]
            elif element.tag == "include" and element.get("file"):
                inner = path.parent / element.get("file", "")
                if inner.is_file() and inner not in found:
                    found[inner] = None
                    waiting.append(inner)
            elif element.tag == "mesh":
                meshes.append(element.get("file") or element.get("filename") or "")
    for name in filter(None, meshes):
        places = [folder / name for folder in folders]
        file = next((place for place in places if place.is_file()), None) or find_mesh(path, name)
        if file is not None:
            found[file] = None
    return list(found)
