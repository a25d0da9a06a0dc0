"""URDF models as MuJoCo specifications.

MuJoCo's own importer drops `<mimic>`, cuts the folders off the paths of meshes, knows no package://
and refuses links without a mass. So the tree is built here: each link is a body, each mimic joint
an equality, and masses, which kinematics do not need, are equal. Angles are in radians; `rpy` turns
about the fixed axes x, y and z.

Meshes are STL, OBJ or MSH. A visual mesh of another kind, such as DAE, is replaced by the collision
geometry of its link.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from math import isfinite
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from egosim_jax.io.bounded import (
    listing,
    open_regular,
    quote,
    quote_path,
    quote_text,
    real_path,
)
from egosim_jax.io.untrusted.xml_tree import Element
from egosim_jax.robots.toml import nearest
from egosim_jax.types import InputError

MESHES = (".stl", ".obj", ".msh")
"""Suffixes of the meshes that MuJoCo reads."""
MAX_LINKS = 1000
"""Maximum number of links."""
KINDS = ("revolute", "continuous", "prismatic", "fixed")
"""Kinds of joints that a robot on a table can have."""
SEEN, SOLID = 2, 3
"""MuJoCo's groups of geometries that are drawn, and of those for collisions alone."""
PACKAGE = "package://"
GRAY = (0.7, 0.7, 0.7, 1.0)


@dataclass(kw_only=True)
class Urdf:
    """Specification of a URDF, and what MuJoCo's does not hold."""

    spec: Any
    """MuJoCo's specification (MjSpec)."""
    speeds: dict[str, float] = field(default_factory=dict)
    """Maximum speed of each joint that has one."""
    continuous: set[str] = field(default_factory=set)
    """Joints that turn without end."""
    replaced: list[str] = field(default_factory=list)
    """Links that are drawn by their collision geometry, because MuJoCo cannot read the visual."""


def read_urdf(path: Path, root: Element, packages: Mapping[str, Path], folder: Path) -> Urdf:
    """Return the specification of a URDF, whose meshes are in `folder`, its own or a package's.

    Raises `InputError` for links that are not a tree, a joint that no arm has, and missing meshes.
    """
    mujoco: Any = import_module("mujoco")

    name = quote_path(path)
    if any(child.tag.startswith("xacro:") for child in root.children):
        raise InputError(f"{name} is a xacro file: expand it first (xacro FILE > my_arm.urdf).")
    links = {_name(link, name): link for link in root.all("link")}
    joints = {_name(joint, name): joint for joint in root.all("joint")}
    for what, named in (("link", links), ("joint", joints)):
        if len(named) < len(root.all(what)):
            raise InputError(f"{name} has two {what}s of one name: rename one of them.")
    if len(links) > MAX_LINKS:
        raise InputError(f"{name} has {len(links):,} links: it may have at most {MAX_LINKS:,}.")
    order = _ordered(links, joints, name)
    urdf = Urdf(spec=mujoco.MjSpec())
    urdf.spec.compiler.degree = False
    files = _Files(path=path, packages=packages, roots=[path.parent, folder, *packages.values()])
    colors = {
        key: value
        for material in root.all("material")
        if (key := material.attributes.get("name")) and (value := _color(material, name))
    }
    bodies: dict[str, Any] = {}
    for link, parent, joint in order:
        bodies[link] = _add_body(urdf, link, parent, joint, joints, bodies, name)
        _add_geometries(urdf, bodies[link], links[link], files, colors, name)
    if files.missing:
        raise InputError(
            f"{name} names {len(files.missing)} meshes that are missing: "
            f"{listing(list(files.missing))}. Restore them, or give the folder of their package in "
            "the description. (packages)"
        )
    for key, joint in joints.items():
        _add_mimic(urdf.spec, key, joint, joints, name)
    return urdf


def _ordered(
    links: Mapping[str, Element], joints: Mapping[str, Element], name: str
) -> list[tuple[str, str, str | None]]:
    """Return each link with its parent and the joint that it hangs on, parents first."""
    above: dict[str, str] = {}
    below: dict[str, list[tuple[str, str, str | None]]] = {}
    for key, joint in joints.items():
        ends = []
        for what in ("parent", "child"):
            end = joint.find(what)
            link = "" if end is None else end.attributes.get("link", "")
            if link not in links:
                raise InputError(
                    f"{name}: the {what} {quote(link)} of the joint {quote(key)} is no link."
                    f"{nearest(link, links)}"
                )
            ends.append(link)
        parent, child = ends
        if child in above:
            raise InputError(
                f"{name}: the link {quote(child)} hangs on two joints, {quote(above[child])} and "
                f"{quote(key)}: a URDF is a tree. Write the loop's second joint as <mimic>."
            )
        above[child] = key
        below.setdefault(parent, []).append((child, parent, key))
    roots = [link for link in links if link not in above]
    if len(roots) != 1:
        raise InputError(
            f"{name} has {len(roots)} links that hang on no joint ({listing(roots)}): it must have "
            "one, the root. Join the others to it by fixed joints."
        )
    order: list[tuple[str, str, str | None]] = [(roots[0], "", None)]
    for link, _, _ in order:  # grows while it is read
        order += below.get(link, [])
    if len(order) < len(links):
        raise InputError(f"{name} has a loop of joints: it must be a tree from its root.")
    return order


def _add_body(
    urdf: Urdf,
    link: str,
    parent: str,
    key: str | None,
    joints: Mapping[str, Element],
    bodies: Mapping[str, Any],
    name: str,
) -> Any:
    """Return the body of a link, with the joint that it hangs on."""
    mujoco: Any = import_module("mujoco")

    if key is None:
        if link == "world":  # MuJoCo's own root
            return urdf.spec.worldbody
        return urdf.spec.worldbody.add_body(name=link)
    joint, where = joints[key], f"{name}: joint {quote(key)}"
    position, turn = _origin(joint, where)
    body = bodies[parent].add_body(name=link, pos=position, quat=turn)
    body.mass, body.inertia, body.explicitinertial = 1.0, [1e-2] * 3, True
    kind = joint.attributes.get("type", "")
    if kind not in KINDS:
        raise InputError(
            f"{where} is of the type {quote(kind)}: it must be one of {', '.join(KINDS)}."
        )
    if kind == "fixed":
        return body
    types = mujoco.mjtJoint
    axis = _numbers(joint.find("axis"), "xyz", (1.0, 0.0, 0.0), where)
    if max(map(abs, axis)) < 1e-6:
        raise InputError(f"{where} has the axis 0 0 0: it must be a direction.")
    added = body.add_joint(
        name=key,
        type=types.mjJNT_SLIDE if kind == "prismatic" else types.mjJNT_HINGE,
        axis=axis,
        limited=mujoco.mjtLimited.mjLIMITED_FALSE,
    )
    limit = joint.find("limit")
    low, high, speed = (
        _numbers(limit, what, (0.0,), where)[0] for what in ("lower", "upper", "velocity")
    )
    if speed > 0:
        urdf.speeds[key] = speed
    if kind == "continuous":
        urdf.continuous.add(key)
    elif low > high:
        raise InputError(f"{where} has the limits {low:g} to {high:g}: exchange them.")
    elif low < high:
        added.limited, added.range = mujoco.mjtLimited.mjLIMITED_TRUE, [low, high]
    return body


def _add_mimic(
    spec: Any, key: str, joint: Element, joints: Mapping[str, Element], name: str
) -> None:
    """Add the equality of a joint that mimics another one."""
    mujoco: Any = import_module("mujoco")

    mimic, where = joint.find("mimic"), f"{name}: the mimic of joint {quote(key)}"
    if mimic is None:
        return
    other = mimic.attributes.get("joint", "")
    if other == key or other not in joints or joints[other].attributes.get("type") == "fixed":
        raise InputError(
            f"{where} follows {quote(other)}, which is no other joint that moves."
            f"{nearest(other, (j for j in joints if j != key))}"
        )
    (factor,), (offset,) = (
        _numbers(mimic, what, (default,), where)
        for what, default in (("multiplier", 1.0), ("offset", 0.0))
    )
    spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1=key,
        name2=other,
        data=[offset, factor, *[0.0] * (mujoco.mjNEQDATA - 2)],
    )


@dataclass(kw_only=True)
class _Files:
    """Files of the meshes that a URDF names."""

    path: Path
    packages: Mapping[str, Path]
    roots: list[Path]
    missing: dict[str, None] = field(default_factory=dict)

    def of(self, text: str) -> Path | None:
        """Return the file of a mesh; None, and note its name, if it is missing."""
        name = quote_path(self.path)
        if text.startswith(PACKAGE):
            package, _, rest = text.removeprefix(PACKAGE).partition("/")
            if package not in self.packages:
                raise InputError(
                    f"{name} names {quote(text)}, and the description has no folder of the package "
                    f'{quote(package)}: add it, such as {quote_text(package)} = "..". (packages)'
                )
            path = self.packages[package] / rest
        else:
            path = self.path.parent / text.removeprefix("file://")
        inside = any(real_path(path).is_relative_to(real_path(root)) for root in self.roots)
        if "\0" in text or not inside:
            raise InputError(
                f"{name} names {quote(text)}, which is outside of its folder, the description's "
                "and the packages': put the file there, or name its package. (packages)"
            )
        if not path.is_file():
            self.missing[quote_text(text)] = None
            return None
        open_regular(path).close()
        return path


def _add_geometries(
    urdf: Urdf,
    body: Any,
    link: Element,
    files: _Files,
    colors: Mapping[str, list[float]],
    name: str,
) -> None:
    """Add the visual and the collision geometry of a link; each replaces the other if it is absent.

    Missing files are noted in `files`.
    """
    where = f"{name}: link {quote(_name(link, name))}"
    solid = [s for e in link.all("collision") if (s := _shape(e, files, where)) is not None]
    seen, replaced = [], []
    for visual in link.all("visual"):
        if (shape := _shape(visual, files, where)) is None:
            continue
        material = visual.find("material")
        color = None if material is None else _color(material, where)
        if color is None and material is not None:
            color = colors.get(material.attributes.get("name", ""))
        suffix = Path(shape.get("file", "a.stl")).suffix.lower()
        if suffix in MESHES:
            seen.append({**shape, "rgba": color or GRAY})
        else:
            replaced.append(suffix)
    for shape in solid:
        if (suffix := Path(shape.get("file", "a.stl")).suffix.lower()) not in MESHES:
            raise InputError(
                f"{where} has the collision mesh {quote_path(shape['file'])}: MuJoCo reads "
                f"{', '.join(MESHES)}, not {quote(suffix)}. Convert it."
            )
    if replaced and not solid:
        raise InputError(
            f"{where} has a visual mesh of the kind {quote(replaced[0])} and no collision geometry "
            f"that could replace it: MuJoCo reads {', '.join(MESHES)}. Convert it."
        )
    if replaced:
        urdf.replaced.append(quote_text(link.attributes["name"]))
        seen = []
    for shape in seen or solid:
        _add_geometry(urdf.spec, body, shape, seen=True, solid=not solid or not seen)
    for shape in solid if seen else []:
        _add_geometry(urdf.spec, body, shape, seen=False, solid=True)


def _shape(element: Element, files: _Files, where: str) -> dict[str, Any] | None:
    """Return type, size and place of a geometry for MuJoCo; None without one."""
    mujoco: Any = import_module("mujoco")

    geometry, types = element.find("geometry"), mujoco.mjtGeom
    if geometry is None or not geometry.children:
        return None
    shape = geometry.children[0]
    position, turn = _origin(element, where)
    place = {"pos": position, "quat": turn}

    def size(key: str, count: int = 1) -> list[float]:
        values = _numbers(shape, key, (0.0,) * count, where)
        if min(values) <= 0:
            raise InputError(f"{where}: the {key} of a {quote_text(shape.tag)} must be above 0.")
        return values

    if shape.tag == "box":
        return {**place, "type": types.mjGEOM_BOX, "size": [x / 2 for x in size("size", 3)]}
    if shape.tag == "sphere":
        return {**place, "type": types.mjGEOM_SPHERE, "size": [*size("radius"), 0, 0]}
    if shape.tag in ("cylinder", "capsule"):
        kind = types.mjGEOM_CYLINDER if shape.tag == "cylinder" else types.mjGEOM_CAPSULE
        (radius,), (length,) = size("radius"), size("length")
        return {**place, "type": kind, "size": [radius, length / 2, 0]}
    if shape.tag == "mesh":
        scale = _numbers(shape, "scale", (1.0, 1.0, 1.0), where)
        path = files.of(shape.attributes.get("filename", ""))
        return path and {**place, "type": types.mjGEOM_MESH, "file": path, "scale": scale}
    raise InputError(
        f"{where} has the geometry {quote(shape.tag)}: it must be a box, sphere, cylinder, capsule "
        "or mesh."
    )


def _add_geometry(spec: Any, body: Any, shape: dict[str, Any], *, seen: bool, solid: bool) -> None:
    mujoco: Any = import_module("mujoco")

    shape = {"rgba": GRAY, **shape}
    if "file" in shape:
        file, scale = str(real_path(shape.pop("file"))), shape.pop("scale")
        name = f"{file} {scale}"
        if spec.mesh(name) is None:  # motors and mirrored links share their meshes
            inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            spec.add_mesh(name=name, file=file, scale=scale, inertia=inertia)
        shape["meshname"] = name
    group = SEEN if seen else SOLID
    body.add_geom(**shape, group=group, contype=int(solid), conaffinity=int(solid))


def _name(element: Element, where: str) -> str:
    if not (name := element.attributes.get("name", "")).strip():
        raise InputError(f"{where} has a {element.tag} without a name: give it one.")
    return name


def _origin(element: Element, where: str) -> tuple[list[float], list[float]]:
    """Return position and quaternion (w, x, y, z) of an element."""
    origin = element.find("origin")
    position = _numbers(origin, "xyz", (0.0, 0.0, 0.0), where)
    turn = Rotation.from_euler("xyz", _numbers(origin, "rpy", (0.0, 0.0, 0.0), where))
    x, y, z, w = turn.as_quat().tolist()
    return position, [w, x, y, z]


def _color(material: Element, where: str) -> list[float] | None:
    color = material.find("color")
    return None if color is None else _numbers(color, "rgba", GRAY, where)


def _numbers(
    element: Element | None, key: str, default: tuple[float, ...], where: str
) -> list[float]:
    """Return the numbers of an attribute, as many as the default has."""
    text = None if element is None else element.attributes.get(key)
    if text is None:
        return list(default)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != len(default) or not all(map(isfinite, values)):
        raise InputError(f"{where}: {key} is {quote(text)}: it must be {len(default)} numbers.")
    return values
