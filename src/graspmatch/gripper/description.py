"""A URDF or MJCF file as a compiled MuJoCo model and the meshes of its links."""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from graspmatch.errors import GraspmatchError
from graspmatch.geometry.mesh import TriangleMesh, concatenate, face_normals_areas, transformed, turned_outwards
from graspmatch.geometry.se3 import from_parts, matrix_from_quaternion
from graspmatch.gripper.card import Card
from graspmatch.gripper.mesh_files import find_file, mesh_for_mujoco
from graspmatch.gripper.toml_table import unknown
from graspmatch.gripper.urdf_tree import refuse_tangled
from graspmatch.types import Link

GEOM = mujoco.mjtGeom
NO_ROOM = 1e-9
"""Between the limits of a joint that cannot move: MuJoCo wants them apart [rad or m]."""
MOVING = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
"""Joints that count; free and ball joints only say where the hand is."""


@dataclass(frozen=True, eq=False)
class Description:
    """A hand as its file describes it, from its base link outwards."""

    path: Path
    files: tuple[Path, ...]
    """The description, what it includes, and every mesh and texture."""
    base_link: str
    base_body: int
    """Index of the base link among the model's bodies."""
    model: mujoco.MjModel
    """With contacts off: for kinematics only."""
    links: tuple[Link, ...]
    """The bodies of the base link's subtree that have geometry."""
    link_bodies: tuple[int, ...]
    """Index of each link among the model's bodies."""
    joint_names: tuple[str, ...]
    """Hinges and slides of the subtree."""


def read_description(path: Path | str, base_link: str) -> Description:
    """The hand below `base_link` in a URDF or MJCF file."""
    model, files = compile_description(Path(path).absolute())
    return describe(model, files, base_link)


def compile_description(path: Path) -> tuple[mujoco.MjModel, tuple[Path, ...]]:
    """The whole file as a model for kinematics, and all files that it is made of, itself first."""
    spec, files = load_spec(path)
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    try:
        return spec.compile(), files
    except ValueError as error:
        raise GraspmatchError(f"MuJoCo cannot build {path}: {error}") from error


def describe(model: mujoco.MjModel, files: tuple[Path, ...], base_link: str) -> Description:
    """The part of a compiled file from `base_link` outwards."""
    path = files[0]
    names = [model.body(i).name for i in range(model.nbody)]
    if base_link not in names:
        raise GraspmatchError(f"{path} has {unknown('base link', base_link, names)}")
    base = names.index(base_link)
    hand = [i for i in range(model.nbody) if is_below(model, i, base)]
    solid = [i for i in hand if solid_geoms(model, i)]
    if not solid:
        raise GraspmatchError(f"{path}: no link from '{base_link}' outwards has any geometry.")
    joints = [i for i in range(model.njnt) if model.jnt_bodyid[i] in hand[1:] and int(model.jnt_type[i]) in MOVING]
    return Description(
        path=path,
        files=files,
        base_link=base_link,
        base_body=base,
        model=model,
        links=tuple(_link(model, i, names[i]) for i in solid),
        link_bodies=tuple(solid),
        joint_names=tuple(model.joint(i).name for i in joints),
    )


def load_spec(path: Path) -> tuple[mujoco.MjSpec, tuple[Path, ...]]:
    """The file as an editable MuJoCo model that carries its meshes as assets, and all files that it is made of."""
    if not path.is_file():
        raise GraspmatchError(f"No gripper description at {path}. It must be a URDF or MJCF file.")
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise GraspmatchError(f"{path} is not valid XML: {error}") from error
    if root.tag not in ("robot", "mujoco"):
        raise GraspmatchError(f"{path} begins with <{root.tag}>; a URDF begins with <robot>, an MJCF with <mujoco>.")
    files, assets = [path], {}
    keep_no_log()
    try:
        spec = _urdf_spec(root, path, files, assets) if root.tag == "robot" else _mjcf_spec(path, files, assets)
    except ValueError as error:
        raise GraspmatchError(f"MuJoCo cannot read {path}: {error}") from error
    spec.assets = assets
    spec.compiler.discardvisual = False
    spec.compiler.fusestatic = False  # a link welded to its parent keeps its name
    # Links that give no inertia.
    spec.compiler.boundmass = max(spec.compiler.boundmass, 1e-6)
    spec.compiler.boundinertia = max(spec.compiler.boundinertia, 1e-12)
    for i, body in enumerate(spec.bodies):
        body.name = body.name or f"body_{i}"
    for i, joint in enumerate(spec.joints):
        joint.name = joint.name or f"joint_{i}"
    return spec, tuple(files)


def keep_no_log() -> None:
    """MuJoCo writes its warnings into a file in the user's folder, where they help nobody."""
    log = mujoco.MjLogConfig.get()
    log.logto_file = False
    log.set()


def content_hash(card: Card, description: Description) -> str:
    """SHA-256 over the card, the description and all meshes: whatever changes the hand changes it."""
    digest = hashlib.sha256()
    for path in (card.path, *description.files):
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def _urdf_spec(root: ElementTree.Element, path: Path, files: list[Path], assets: dict[str, bytes]) -> mujoco.MjSpec:
    if any("ros.org/wiki/xacro" in element.tag or "xacro" in element.tag for element in root.iter()):
        raise GraspmatchError(f"{path} is a xacro template; expand it first: xacro {path.name} > hand.urdf")
    refuse_tangled(root, path)
    known: dict[tuple[Path, str], str] = {}
    for link in root.iter("link"):
        for mesh in link.iter("mesh"):
            found = _required(mesh.get("filename", ""), path.parent, path, link.get("name", ""), "mesh")
            # MuJoCo names a URDF mesh by the stem of its file and takes the first of two with equal stems for both.
            key = (found, mesh.get("scale", "1 1 1"))
            if key not in known:
                known[key] = _add_asset(found, f"{found.stem}_{len(known)}", files, assets)
            mesh.set("filename", known[key])
    extension = root.find("mujoco")
    extension = ElementTree.SubElement(root, "mujoco") if extension is None else extension
    compiler = extension.find("compiler")
    compiler = ElementTree.SubElement(extension, "compiler") if compiler is None else compiler
    compiler.attrib.pop("meshdir", None)
    compiler.attrib.update(strippath="false", discardvisual="false", fusestatic="false", balanceinertia="true")
    # The reader takes the settings as it goes, so they must come before the first link.
    root.remove(extension)
    root.insert(0, extension)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"), assets=assets)
    for joint in root.iter("joint"):
        limit = joint.find("limit")
        if joint.get("type") in ("revolute", "prismatic") and limit is not None and joint.find("mimic") is None:
            low, high = (float(limit.get(end, 0)) for end in ("lower", "upper"))
            if low == high:  # which MuJoCo would take for no limits
                stiff = next(j for j in spec.joints if j.name == joint.get("name"))
                stiff.limited, stiff.range = mujoco.mjtLimited.mjLIMITED_TRUE, (low, low + NO_ROOM)
    for mesh in spec.meshes:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX  # open and inside-out meshes have one too
    return spec


def _mjcf_spec(path: Path, files: list[Path], assets: dict[str, bytes]) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_file(str(path))
    files.extend(_included_files(path, path.parent))
    users = {geom.meshname: body.name for body in spec.bodies for geom in body.geoms if geom.meshname}
    folders = {"mesh": path.parent / spec.meshdir, "texture": path.parent / (spec.texturedir or spec.meshdir)}
    for kind, entries in (("mesh", spec.meshes), ("texture", spec.textures)):
        for entry in (e for e in entries if e.file):
            reference = Path(entry.file).name if spec.strippath else entry.file
            entry.name = entry.name or Path(entry.file).stem
            found = _required(reference, folders[kind], path, users.get(entry.name, ""), kind)
            entry.file = _add_asset(found, f"{found.stem}_{len(files)}", files, assets, convert=kind == "mesh")
    spec.meshdir = spec.texturedir = ""
    return spec


def _required(reference: str, folder: Path, path: Path, link: str, kind: str) -> Path:
    found = find_file(reference, folder)
    if found is None:
        place = f"link '{link}' needs" if link else "it needs"
        looked = "its folder, those above it and ROS_PACKAGE_PATH" if "://" in reference else str(folder)
        raise GraspmatchError(f"{path}: {place} the {kind} '{reference}', which is not there (looked in {looked}).")
    return found


def _add_asset(path: Path, name: str, files: list[Path], assets: dict[str, bytes], *, convert: bool = True) -> str:
    """Give the file to MuJoCo under a name of its own, which is returned."""
    suffix, content = mesh_for_mujoco(path) if convert else (path.suffix, path.read_bytes())
    assets[name + suffix] = content
    if path not in files:
        files.append(path)
    return name + suffix


def _included_files(path: Path, folder: Path) -> list[Path]:
    """Files that an MJCF includes, and that those include, relative to the folder of the outermost."""
    names = [element.get("file", "") for element in ElementTree.parse(path).iter("include")]
    direct = [folder / name for name in names]
    return direct + [inner for file in direct for inner in _included_files(file, folder)]


def is_below(model: mujoco.MjModel, body: int, base: int) -> bool:
    """Whether a body is the base or hangs on it."""
    while body > base:  # parents come first
        body = int(model.body_parentid[body])
    return body == base


def solid_geoms(model: mujoco.MjModel, body: int) -> list[int]:
    """The geoms of a body that bound a solid."""
    start = model.body_geomadr[body]
    geoms = range(start, start + model.body_geomnum[body])
    return [int(g) for g in geoms if int(model.geom_type[g]) not in (GEOM.mjGEOM_PLANE, GEOM.mjGEOM_HFIELD)]


def _link(model: mujoco.MjModel, body: int, name: str) -> Link:
    geoms = solid_geoms(model, body)
    touching = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
    shown = [g for g in geoms if g not in touching] or geoms
    meshes = {g: geom_mesh(model, g) for g in geoms}
    largest = max(shown, key=lambda g: face_normals_areas(meshes[g])[1].sum())
    material = model.geom_matid[largest]
    rgba = model.geom_rgba[largest] if material < 0 else model.mat_rgba[material]
    return Link(
        name=name,
        collision=concatenate([meshes[g] for g in touching or geoms]),
        visual=concatenate([meshes[g] for g in shown]),
        rgba=(float(rgba[0]), float(rgba[1]), float(rgba[2]), float(rgba[3])),
    )


def geom_mesh(model: mujoco.MjModel, geom: int) -> TriangleMesh:
    """Triangles of a geom in the frame of its body."""
    T_body_geom = from_parts(matrix_from_quaternion(model.geom_quat[geom]), model.geom_pos[geom])
    kind = int(model.geom_type[geom])
    if kind in (GEOM.mjGEOM_MESH, GEOM.mjGEOM_SDF):
        # MuJoCo moves a mesh to its inertial frame and moves the geom the other way: the geom's pose undoes both.
        mesh = model.geom_dataid[geom]
        vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
        faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
        return transformed(turned_outwards(TriangleMesh(vertices.astype(float), faces.astype(int))), T_body_geom)
    return transformed(_primitive(kind, model.geom_size[geom]), T_body_geom)


def _primitive(kind: int, size: np.ndarray) -> TriangleMesh:
    """A primitive of MuJoCo (half sizes) as triangles, centred, along z."""
    from trimesh import creation

    if kind == GEOM.mjGEOM_BOX:
        shape = creation.box(extents=2 * size)
    elif kind == GEOM.mjGEOM_CYLINDER:
        shape = creation.cylinder(radius=size[0], height=2 * size[1], sections=32)
    elif kind == GEOM.mjGEOM_CAPSULE:
        shape = creation.capsule(height=2 * size[1], radius=size[0], count=(16, 24))
    else:
        shape = creation.icosphere(subdivisions=3)
        shape.apply_scale(size[0] if kind == GEOM.mjGEOM_SPHERE else size)
    return TriangleMesh(np.asarray(shape.vertices, dtype=float), np.asarray(shape.faces, dtype=int))
