"""Cards, description files and postures: small hands made here, and real ones where the shared data is present."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from graspmatch.geometry.mesh import TriangleMesh, face_normals_areas, transformed
from graspmatch.gripper.card import postures, read_card
from graspmatch.gripper.description import content_hash, load_spec, read_description
from graspmatch.gripper.kinematics import HandModel, load_hand, pose_links, solve_posture
from graspmatch.types import GraspmatchError

DATA = Path(__file__).parents[1] / ".." / "shared" / "data" / "grippers"

CARD = """
name = "tongs"
description = "tongs.urdf"
base_link = "base"
approach = [0, 0, 2]
closing = [0, 3, 0.3]
tool_centre_point = [0, 0, 0.1]
finger_force = 10
opening = 0.08
palm = ["base"]
{joints}
[couplings.tip_joint]
joint = "left_joint"
multiplier = 0.5
offset = 0.1
[[fingers]]
name = "left"
links = ["left", "tip"]
joints = ["left_joint"]
[preshapes]
steps = 3
closing = [0.0, 0.5]
[[preshapes.poses]]
name = "wide"
joints = {{ left_joint = 0.2 }}
"""
JOINTS = "[joints.left_joint]\nopen = 0\nclosed = 1.0\n[joints.turn]\nopen = 0.25\n"

URDF = """<robot name="tongs">
  <link name="base"><visual><geometry><box size="0.1 0.1 0.02"/></geometry></visual></link>
  <link name="arm"/>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <link name="left">
    <visual><geometry><mesh filename="{visual}"/></geometry>
      <material name="m"><color rgba="1 0 0 1"/></material></visual>
    <collision><origin xyz="0 0 0.05"/><geometry><mesh filename="{collision}" scale="1 1 2"/></geometry></collision>
  </link>
  <joint name="left_joint" type="revolute"><parent link="arm"/><child link="left"/><axis xyz="1 0 0"/>
    <origin xyz="0 0.04 0"/><limit lower="0" upper="1.2" effort="1" velocity="1"/></joint>
  <link name="tip"><collision><geometry><sphere radius="0.01"/></geometry></collision></link>
  <joint name="tip_joint" type="revolute"><parent link="left"/><child link="tip"/><axis xyz="1 0 0"/>
    <origin xyz="0 0 0.1"/><limit lower="0" upper="0.3" effort="1" velocity="1"/></joint>
  <link name="pad"><visual><geometry><cylinder radius="0.01" length="0.004"/></geometry></visual></link>
  <joint name="weld" type="fixed"><parent link="tip"/><child link="pad"/><origin xyz="0 0 0.01"/></joint>
  <link name="mirror"><visual><geometry><box size="0.01 0.01 0.1"/></geometry></visual></link>
  <joint name="mirror_joint" type="revolute"><parent link="base"/><child link="mirror"/><axis xyz="1 0 0"/>
    <limit lower="-1.2" upper="1.2" effort="1" velocity="1"/>
    <mimic joint="left_joint" multiplier="-1" offset="0.2"/></joint>
</robot>"""


def make_tongs(
    folder: Path,
    *,
    visual: str = "finger.stl",
    collision: str = "finger.stl",
    joints: str = JOINTS,
    change: tuple[str, str] = ("", ""),
) -> Path:
    """A hand of one finger with a mimic joint, a card coupling and a mesh; the path of its card."""
    folder.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(extents=(0.02, 0.01, 0.05)).export(folder / "finger.stl")
    (folder / "tongs.urdf").write_text(URDF.format(visual=visual, collision=collision))
    (folder / "tongs.toml").write_text(
        CARD.format(joints=joints).replace(*change) if change[0] else CARD.format(joints=joints)
    )
    return folder / "tongs.toml"


def real_card(
    folder: Path,
    file: str,
    base: str,
    joints: Mapping[str, tuple[float, float | None]],
    links: list[str],
    extra: str = "",
) -> Path:
    """A card for a hand of the shared data, one finger with the given links."""
    path = (DATA / file).resolve()
    if not path.is_file():
        pytest.skip(f"the shared gripper data is absent: no {path}")
    table = "".join(
        f"[joints.{name}]\nopen = {a}\n" + ("" if b is None else f"closed = {b}\n") for name, (a, b) in joints.items()
    )
    closing = [name for name, (_, b) in joints.items() if b is not None]
    card = folder / "card.toml"
    card.write_text(
        f'name = "hand"\ndescription = "{path}"\nbase_link = "{base}"\napproach = [0, 0, 1]\nclosing = [0, 1, 0]\n'
        f"tool_centre_point = [0, 0, 0.1]\nfinger_force = 10\nopening = 0.08\npalm = []\n{table}"
        f'[[fingers]]\nname = "all"\nlinks = {links}\njoints = {closing}\n{extra}'
    )
    return card


def named(hand: HandModel, T_gripper_link: np.ndarray) -> dict[str, np.ndarray]:
    return {link.name: T for link, T in zip(hand.links, T_gripper_link, strict=True)}


def joint_value(hand: HandModel, posture: np.ndarray, name: str) -> float:
    model = hand.description.model
    return float(posture[model.jnt_qposadr[model.joint(name).id]])


def test_card_axes_are_unit_and_perpendicular(tmp_path: Path) -> None:
    card = read_card(make_tongs(tmp_path))
    np.testing.assert_allclose(card.approach, [0, 0, 1])
    np.testing.assert_allclose(card.closing, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(card.closed_joints, [1.0, 0.25])


def test_preshapes_follow_the_rule_and_keep_the_order_asked_for(tmp_path: Path) -> None:
    change = ("closing = [0.0, 0.5]", "closing = [0.0, 0.5]\nspread = { turn = [-0.5, 0.5] }")
    shapes = postures(read_card(make_tongs(tmp_path, change=change)), ["turn", "left_joint"])
    assert [shape.name for shape in shapes][:2] == ["spread_-0.5_close_0", "spread_-0.5_close_25"]
    assert len({shape.name for shape in shapes}) == 7
    np.testing.assert_allclose(shapes[5].joints, [0.5, 0.5])
    assert shapes[6].name == "wide"
    np.testing.assert_allclose(shapes[6].joints, [0.25, 0.2])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("finger_force = 10", "finger_force = -1"), "finger_force is -1; it must be a number above zero"),
        (("opening = 0.08", "openning = 0.08"), r"no key 'openning'. Did you mean 'opening'\? Known: approach"),
        (("opening = 0.08", ""), "opening is missing"),
        (("approach = [0, 0, 2]", "approach = [0, 0, 0]"), "approach has no length"),
        (("approach = [0, 0, 2]", "approach = [0, 0]"), "a list of 3 numbers"),
        (("closing = [0, 3, 0.3]", "closing = [0, 0, 1]"), "closing is parallel to approach"),
        (("steps = 3", "steps = 2.5"), "preshapes.steps is 2.5"),
        (("wide", 'wide"'), "not valid TOML"),
        (('joints = ["left_joint"]', 'joints = ["turn"]'), "no driven joint that closes 'turn'"),
        (("left_joint = 0.2", "lift_joint = 0.2"), "no driven joint 'lift_joint'"),
    ],
)
def test_mistakes_in_a_card_are_named_with_its_path(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    path = make_tongs(tmp_path, change=change)
    with pytest.raises(GraspmatchError, match=message) as caught:
        read_card(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[joints.turn]", "[joints.trun]"), "no joint 'trun'. Did you mean 'turn'"),
        (('base_link = "base"', 'base_link = "bas"'), "no base link 'bas'. Did you mean 'base'"),
        (('links = ["left", "tip"]', 'links = ["left", "arm"]'), "no link with geometry 'arm'.*Known: base, left"),
        (('joint = "left_joint"', 'joint = "nothing"'), "couplings.tip_joint: .* no joint 'nothing'"),
        (("closed = 1.0", "closed = 1.3"), "preshape 'closed' puts joint 'left_joint' at 1.3; its limits are 0 to 1.2"),
        (("left_joint = 0.2", "left_joint = -0.2"), "preshape 'wide' puts joint 'left_joint' at -0.2"),
        (('palm = ["base"]', 'palm = ["tip"]'), "link 'tip' can belong to the palm or to one finger"),
        (('description = "tongs.urdf"', 'description = "other.urdf"'), "No gripper description at"),
    ],
)
def test_what_card_and_description_disagree_on_is_named(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    with pytest.raises(GraspmatchError, match=message):
        load_hand(make_tongs(tmp_path, change=change))


def test_followers_of_file_and_card_follow(tmp_path: Path) -> None:
    hand = load_hand(make_tongs(tmp_path))
    assert hand.joint_names == ("left_joint", "turn")
    np.testing.assert_allclose(hand.upper, [1.2, 1.0])
    posture = solve_posture(hand, np.array([0.8, 0.1]))
    assert joint_value(hand, posture, "mirror_joint") == pytest.approx(-0.6, abs=1e-9)
    assert joint_value(hand, posture, "tip_joint") == pytest.approx(0.5, abs=1e-9)  # though its own limit is 0.3


def test_links_stand_where_the_joints_put_them(tmp_path: Path) -> None:
    hand = load_hand(make_tongs(tmp_path))
    T = named(hand, pose_links(hand, np.array([0.6, 0.0])))
    np.testing.assert_allclose(T["base"], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(T["left"][:3, 3], [0, 0.04, 0], atol=1e-9)
    np.testing.assert_allclose(T["tip"][:3, 3], [0, 0.04 - 0.1 * np.sin(0.6), 0.1 * np.cos(0.6)], atol=1e-9)
    lean = np.array([0, -np.sin(1.0), np.cos(1.0)])  # 0.6 of the driven joint, 0.5 * 0.6 + 0.1 of the follower
    np.testing.assert_allclose(T["pad"][:3, 3] - T["tip"][:3, 3], 0.01 * lean, atol=1e-9)


def test_meshes_are_in_the_frame_of_their_link(tmp_path: Path) -> None:
    links = {link.name: link for link in load_hand(make_tongs(tmp_path)).links}
    assert set(links) == {"base", "left", "tip", "pad", "mirror"}  # 'arm' has no geometry
    visual, collision = links["left"].visual.vertices, links["left"].collision.vertices
    np.testing.assert_allclose(
        [visual.min(0), visual.max(0)], [[-0.01, -0.005, -0.025], [0.01, 0.005, 0.025]], atol=1e-6
    )
    np.testing.assert_allclose(
        [collision.min(0), collision.max(0)], [[-0.01, -0.005, 0], [0.01, 0.005, 0.1]], atol=1e-6
    )
    assert links["left"].rgba == (1.0, 0.0, 0.0, 1.0)
    assert links["base"].collision.vertices.max() == pytest.approx(0.05)  # a link without collision geometry


def test_primitives_become_closed_solids_of_their_volume(tmp_path: Path) -> None:
    half, r = 0.05, 0.02
    volumes = {
        f'type="box" size="{r} {r} {half}"': 8 * r * r * half,
        f'type="cylinder" size="{r} {half}"': np.pi * r**2 * 2 * half,
        f'type="capsule" size="{r} {half}"': np.pi * r**2 * 2 * half + 4 / 3 * np.pi * r**3,
        f'type="sphere" size="{r}"': 4 / 3 * np.pi * r**3,
        f'type="ellipsoid" size="{r} {r} {half}"': 4 / 3 * np.pi * r * r * half,
    }
    path = tmp_path / "solid.xml"
    for geom, volume in volumes.items():
        path.write_text(
            '<mujoco><worldbody><body name="b" pos="1 2 3">'
            f'<geom {geom} pos="0.1 0 0" euler="90 0 0"/></body></worldbody></mujoco>'
        )
        mesh = read_description(path, "b").links[0].collision
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
        assert solid.is_watertight, geom
        assert solid.volume == pytest.approx(volume, rel=0.04), geom
        np.testing.assert_allclose(solid.bounds.mean(axis=0), [0.1, 0, 0], atol=1e-6)
        assert np.argmax(solid.extents) == 1 or "sphere" in geom, geom  # turned from z to y


def test_package_paths_are_found_above_the_description_and_on_the_ros_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reference = "package://tongs_description/meshes/finger.stl"
    near = make_tongs(tmp_path / "ws" / "tongs_description" / "urdf", visual=reference)
    far = make_tongs(tmp_path / "elsewhere", visual=reference)
    meshes = tmp_path / "ws" / "tongs_description" / "meshes"
    meshes.mkdir()
    trimesh.creation.box(extents=(0.3, 0.3, 0.3)).export(meshes / "finger.stl")
    with pytest.raises(GraspmatchError, match=r"link 'left' needs the mesh 'package://.*ROS_PACKAGE_PATH"):
        load_hand(far)
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "ws"))
    for card in (near, far):
        left = next(link for link in load_hand(card).links if link.name == "left")
        assert np.ptp(left.visual.vertices, axis=0) == pytest.approx([0.3, 0.3, 0.3])
        assert np.ptp(left.collision.vertices, axis=0) == pytest.approx([0.02, 0.01, 0.1])  # same stem, other file


def test_missing_mesh_names_link_and_file(tmp_path: Path) -> None:
    with pytest.raises(GraspmatchError, match=r"link 'left' needs the mesh 'gone\.stl'"):
        load_hand(make_tongs(tmp_path, collision="gone.stl"))
    (tmp_path / "hand.xml").write_text(
        '<mujoco><asset><mesh name="m" file="gone.obj"/></asset><worldbody>'
        '<body name="palm"><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    with pytest.raises(GraspmatchError, match=r"link 'palm' needs the mesh 'gone\.obj'"):
        read_description(tmp_path / "hand.xml", "palm")


@pytest.mark.parametrize("suffix", ["dae", "glb", "ply", "ascii.stl"])
def test_formats_that_mujoco_does_not_read_give_the_same_mesh(tmp_path: Path, suffix: str) -> None:
    shape = trimesh.creation.cylinder(radius=0.02, height=0.1)
    shape.apply_translation([0.01, 0.02, 0.03])
    shape.export(tmp_path / f"finger.{suffix}", file_type="stl_ascii" if suffix == "ascii.stl" else suffix)
    hand = load_hand(make_tongs(tmp_path, visual=f"finger.{suffix}"))
    mesh = next(link for link in hand.links if link.name == "left").visual
    np.testing.assert_allclose([mesh.vertices.min(0), mesh.vertices.max(0)], shape.bounds, atol=1e-6)
    assert face_normals_areas(mesh)[1].sum() == pytest.approx(shape.area, rel=1e-5)


def test_collada_in_millimetres_becomes_metres(tmp_path: Path) -> None:
    trimesh.creation.box(extents=(20, 10, 50)).export(tmp_path / "finger.dae")
    text = (tmp_path / "finger.dae").read_text()
    assert "<unit" not in text
    (tmp_path / "finger.dae").write_text(text.replace("<up_axis>", '<unit name="mm" meter="0.001"/><up_axis>'))
    left = next(link for link in load_hand(make_tongs(tmp_path, visual="finger.dae")).links if link.name == "left")
    np.testing.assert_allclose(np.ptp(left.visual.vertices, axis=0), [0.02, 0.01, 0.05], atol=1e-7)


def test_content_hash_changes_with_card_description_and_mesh_only(tmp_path: Path) -> None:
    card_path = make_tongs(tmp_path)

    def now() -> str:
        card = read_card(card_path)
        return content_hash(card, read_description(card.description, card.base_link))

    hashes = [now()]
    assert now() == hashes[0]
    for name, add in [("tongs.toml", b"\n"), ("tongs.urdf", b"\n")]:
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes() + add)
        hashes.append(now())
    trimesh.creation.box(extents=(0.02, 0.01, 0.06)).export(tmp_path / "finger.stl")
    hashes.append(now())
    (tmp_path / "unused.stl").write_bytes(b"nothing")
    assert now() == hashes[-1]
    assert len(set(hashes)) == 4


def test_a_hand_is_read_once_until_its_card_changes(tmp_path: Path) -> None:
    path = make_tongs(tmp_path)
    hand = load_hand(path)
    assert load_hand(path) is hand
    path.write_text(path.read_text().replace("opening = 0.08", "opening = 0.07"))
    assert load_hand(path).card.opening == 0.07


def test_contradicting_couplings_are_refused_by_name(tmp_path: Path) -> None:
    hand = load_hand(make_tongs(tmp_path, change=("[couplings.tip_joint]", "[couplings.mirror_joint]")))
    with pytest.raises(GraspmatchError, match=r"no posture .* left_joint = 0.8.* mirror_joint"):
        solve_posture(hand, np.array([0.8, 0.0]))


PARALLELOGRAM = """<mujoco><default><joint axis="0 1 0"/><geom size=".005"/></default><worldbody>
  <body name="base"><geom/>
    <body name="crank"><joint name="crank"/><geom/>
      <body name="coupler" pos="0 0 .1"><joint name="coupler"/><geom/></body></body>
    <body name="rocker" pos=".1 0 0"><joint name="rocker"/><geom/>
      <body name="block" pos="0 0 .1"><joint name="block"/><geom/></body></body>
    <body name="far" pos=".3 0 0"><joint name="far"/><geom/></body></body></worldbody>
  <tendon><fixed name="sum"><joint joint="crank" coef="1"/><joint joint="far" coef="2"/></fixed></tendon>
  <equality>{loop}<tendon tendon1="sum"/></equality></mujoco>"""


@pytest.mark.parametrize(
    "loop",
    [
        '<connect body1="coupler" body2="rocker" anchor=".1 0 0"/>',
        '<weld body1="coupler" body2="block" relpose=".1 0 0 1 0 0 0"/>',
    ],
)
def test_loops_and_tendons_hold_over_a_long_way(tmp_path: Path, loop: str) -> None:
    (tmp_path / "loop.xml").write_text(PARALLELOGRAM.format(loop=loop))
    card = tmp_path / "loop.toml"
    head = CARD.format(joints="[joints.crank]\nopen = 0\nclosed = 0.9\n").split("[couplings")[0]
    card.write_text(head + '[[fingers]]\nname = "one"\nlinks = ["crank"]\njoints = ["crank"]\n')
    hand = load_hand(card, tmp_path / "loop.xml")
    posture = solve_posture(hand, np.array([0.9]))
    for name, value in {"rocker": 0.9, "coupler": -0.9, "far": -0.45}.items():
        assert joint_value(hand, posture, name) == pytest.approx(value, abs=1e-6)


def test_a_spec_can_be_attached_to_another_world(tmp_path: Path) -> None:
    card = read_card(make_tongs(tmp_path))
    world = mujoco.MjSpec()
    world.attach(load_spec(Path(card.description))[0], prefix="hand_", frame=world.worldbody.add_frame())
    assert "hand_tip" in [body.name for body in world.bodies]
    assert world.compile().nmesh == 2


def test_franka_fingers_mirror_each_other(tmp_path: Path) -> None:
    joints = {"finger_joint1": (0.04, 0.0)}
    hand = load_hand(real_card(tmp_path, "franka_emika_panda/hand.xml", "hand", joints, ["left_finger"]))
    for opening in (0.0, 0.013, 0.04):
        T = named(hand, pose_links(hand, np.array([opening])))
        np.testing.assert_allclose(T["left_finger"][:3, 3], [0, opening, 0.0584], atol=1e-9)
        np.testing.assert_allclose(T["right_finger"][:3, 3], [0, -opening, 0.0584], atol=1e-9)


def robotiq_2f85(folder: Path) -> HandModel:
    links = ["right_pad", "left_pad"]
    return load_hand(
        real_card(folder, "robotiq_2f85/2f85.xml", "base_mount", {"right_driver_joint": (0.0, 0.8)}, links)
    )


def test_robotiq_2f85_pads_stay_square_to_the_closing_axis_and_its_loops_closed(tmp_path: Path) -> None:
    hand = robotiq_2f85(tmp_path)
    gaps = []
    for driven in np.linspace(0, 0.8, 9):
        T = named(hand, pose_links(hand, np.array([driven])))
        inward = T["right_pad"][:3, 1], T["left_pad"][:3, 1]
        # The linkage of the file itself tilts each pad by up to 1.9 degrees; its simulation does the same.
        assert all(np.degrees(np.arccos(min(abs(normal[0]), 1.0))) < 2.0 for normal in inward)
        assert inward[0] @ inward[1] < 0
        gaps.append(abs((T["right_pad"] - T["left_pad"])[:3, 3] @ [1, 0, 0]))
        data = mujoco.MjData(hand.description.model)
        data.qpos[:] = solve_posture(hand, np.array([driven]))
        mujoco.mj_fwdPosition(hand.description.model, data)
        assert np.abs(data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]).max() < 1e-4
    assert np.all(np.diff(gaps) < 0)
    assert gaps[0] - gaps[-1] > 0.08  # its stroke


def test_robotiq_2f85_posture_does_not_depend_on_what_was_asked_before(tmp_path: Path) -> None:
    first, second = (robotiq_2f85(tmp_path / name) for name in ("a", "b") if not (tmp_path / name).mkdir())
    for value in (0.77, 0.13, 0.41):
        solve_posture(first, np.array([value]))
    np.testing.assert_array_equal(solve_posture(first, np.array([0.5])), solve_posture(second, np.array([0.5])))


def test_robotiq_2f85_rests_where_its_simulation_comes_to_rest(tmp_path: Path) -> None:
    hand = robotiq_2f85(tmp_path)
    model = load_spec(hand.description.path)[0].compile()
    model.opt.gravity[:] = 0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(model)
    data.ctrl[:] = 255 * 0.5 / 0.8
    mujoco.mj_step(model, data, 3000)
    driven = data.qpos[model.jnt_qposadr[model.joint("right_driver_joint").id]]
    np.testing.assert_allclose(solve_posture(hand, np.array([driven])), data.qpos, atol=1e-3)


def test_barrett_tips_and_spread_follow(tmp_path: Path) -> None:
    joints = {name: (0.0, 2.4) for name in ("bh_j12_joint", "bh_j22_joint", "bh_j32_joint")} | {
        "bh_j11_joint": (0.0, None)
    }
    hand = load_hand(
        real_card(tmp_path, "barrett_bh282/derived/bh282.urdf", "bh_base_link", joints, ["bh_finger_12_link"])
    )
    posture = solve_posture(hand, np.array([2.4, 1.0, 0.5, 1.57]))
    for tip, value in [("bh_j13_joint", 2.4), ("bh_j23_joint", 1.0), ("bh_j33_joint", 0.5)]:
        assert joint_value(hand, posture, tip) == pytest.approx(0.34426 * value, abs=1e-4)
    assert joint_value(hand, posture, "bh_j21_joint") == pytest.approx(1.57, abs=1e-9)


def test_kinova_tips_follow_the_card(tmp_path: Path) -> None:
    joints = {f"j2s7s300_joint_finger_{i}": (0.0, 1.5) for i in (1, 2, 3)}
    extra = "".join(
        f'[couplings.j2s7s300_joint_finger_tip_{i}]\njoint = "j2s7s300_joint_finger_{i}"\nmultiplier = 0.7\n'
        for i in (1, 2, 3)
    )
    links = ["j2s7s300_link_finger_1", "j2s7s300_link_finger_tip_1"]
    hand = load_hand(real_card(tmp_path, "kinova_kg3/derived/kg3.urdf", "j2s7s300_link_7", joints, links, extra))
    posture = solve_posture(hand, np.array([1.0, 0.5, 0.0]))
    assert joint_value(hand, posture, "j2s7s300_joint_finger_tip_1") == pytest.approx(0.7, abs=1e-9)
    assert joint_value(hand, posture, "j2s7s300_joint_finger_tip_2") == pytest.approx(0.35, abs=1e-9)
    T = pose_links(hand, np.array([0.7, 0.7, 0.7]))
    assert hand.links[0].name == "j2s7s300_link_7"  # the root of a URDF keeps its name
    assert T.shape == (7, 4, 4)


@pytest.mark.parametrize(
    ("file", "base", "least", "extent"),
    [
        ("robotiq_3f/derived/robotiq_3f.urdf", "palm", 12, 0.25),
        ("wonik_allegro/right_hand.xml", "palm", 17, 0.2),
        ("shadow_hand/right_hand.xml", "rh_forearm", 20, 0.45),
        ("barrett_bh280_dex_urdf/barrett_hand/bhand_model.urdf", "base_link", 8, 0.33),
        ("barrett_bh282/derived/bh280.urdf", "bh_base_link", 8, 0.33),
    ],
)
def test_real_hands_load_whole_and_in_metres(file: str, base: str, least: int, extent: float, tmp_path: Path) -> None:
    if not (DATA / file).is_file():
        pytest.skip(f"the shared gripper data is absent: no {DATA / file}")
    description = read_description(DATA / file, base)
    assert len(description.links) >= least
    assert all(len(link.collision.faces) and len(link.visual.faces) for link in description.links)
    low, high = description.model.joint(description.joint_names[-1]).range
    joints = {description.joint_names[-1]: (low, high)}
    hand = load_hand(real_card(tmp_path, file, base, joints, [description.links[-1].name]))
    T_gripper_link = pose_links(hand, np.array([(low + high) / 2]))
    points = [transformed(link.visual, T).vertices for link, T in zip(hand.links, T_gripper_link, strict=True)]
    size = np.ptp(np.concatenate(points), axis=0)
    assert size.max() == pytest.approx(extent, rel=0.35)
    # What shows and what touches is the same hand: their boxes agree.
    boxes = [np.stack([p.min(0), p.max(0)]) for p in points]
    touch = [transformed(link.collision, T).vertices for link, T in zip(hand.links, T_gripper_link, strict=True)]
    gaps = [np.abs(box - np.stack([p.min(0), p.max(0)])).max() for box, p in zip(boxes, touch, strict=True)]
    assert np.median(gaps) < 0.02


def test_shapes_of_a_link_do_not_move_with_the_joints(tmp_path: Path) -> None:
    hand = robotiq_2f85(tmp_path)
    for a, b in itertools.pairwise(pose_links(hand, np.array([x])) for x in (0.0, 0.4, 0.8)):
        np.testing.assert_allclose(
            a[:, :3, :3] @ a[:, :3, :3].transpose(0, 2, 1), np.broadcast_to(np.eye(3), b[:, :3, :3].shape), atol=1e-9
        )
        np.testing.assert_allclose(np.linalg.det(b[:, :3, :3]), 1.0, atol=1e-9)
    assert isinstance(hand.links[0].collision, TriangleMesh)
