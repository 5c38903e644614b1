"""XML files as they are written, before anybody makes sense of them."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dexctl.exceptions import HandModelError


def parse_xml(path: Path) -> ElementTree.Element:
    """The root element of an XML file.

    Raises:
        HandModelError: it is not well-formed, or in an encoding that is not known.
    """
    try:
        return ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise HandModelError(f"{path}: not well-formed XML: {error}") from None


def check_numbers(path: Path) -> None:
    """Raise where an MJCF file says what MuJoCo passes over: NaN, a lower limit above the upper.

    Included files are not looked into.

    Raises:
        HandModelError: the message names the element and the attribute.
    """
    try:
        root = parse_xml(path)
    except HandModelError as error:
        if "encoding" in str(error):  # which MuJoCo passes over, and reads wrongly
            raise
        return  # MuJoCo's own reader takes more, and has the last word
    for element, body in _with_bodies(root):
        for attribute, text in element.attrib.items():
            try:
                values = np.array([float(word) for word in text.split()])
            except ValueError:
                continue
            wrong = None
            if np.isnan(values).any():
                wrong = "not a number"
            elif attribute == "range" and len(values) == 2 and values[0] > values[1]:
                wrong = "a lower limit above the upper"
            if wrong:
                name = element.get("name") or element.get("joint") or element.get("class")
                which = f"<{element.tag}>"
                which += f" {name!r}" if name else f" of the body {body!r}" if body else ""
                raise HandModelError(f"{path}: {which} has {attribute}={text!r}: {wrong}")


def _with_bodies(root: ElementTree.Element) -> Iterator[tuple[ElementTree.Element, str]]:
    """Every element, and the name of the body that it is in; "" where there is none."""
    waiting = [(root, "")]
    while waiting:  # files may be nested deeper than calls can be
        element, body = waiting.pop()
        yield element, body
        inside = element.get("name", body) if element.tag == "body" else body
        waiting += [(one, inside) for one in reversed(element)]


def root_tag(path: Path) -> str:
    """The name of an XML file's root element.

    Raises:
        HandModelError: the file is not XML.
    """
    try:
        for _, element in ElementTree.iterparse(path, events=("start",)):
            return element.tag
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise HandModelError(f"{path}: not well-formed XML: {error}") from None
    raise HandModelError(f"{path}: no element in it")
