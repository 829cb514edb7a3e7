"""The judge is judged first: pinches whose outcome is known."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from graspmatch.config import ForceClosureConfig, LiftConfig, TugConfig
from graspmatch.geometry.se3 import from_parts, rotation_exp, translation
from graspmatch.simulate.contacts import touch
from graspmatch.simulate.free import force_closure, force_closure_physics, tug, tug_physics
from graspmatch.simulate.hand import OBJECT_BIT
from graspmatch.simulate.lift import lift, lift_physics
from graspmatch.simulate.motion import Recording, Run
from graspmatch.simulate.settle import settle
from graspmatch.simulate.stroke import stroke_from
from graspmatch.simulate.world import Physics, World, build_world, gripper_pose, object_pose, place
from judge_scenes import HANDS, box, cube, from_above, half_open, hand, pinch

GRAVITY = 9.81


@pytest.mark.parametrize("name", HANDS)
def test_a_centred_pinch_holds_and_touches_with_opposed_fingers(name: str) -> None:
    verdict = pinch(hand(name), cube(), LiftConfig())
    assert verdict.held, verdict.reason
    assert verdict.fingers >= 2
    assert verdict.slip < 0.01
    assert verdict.depth < 0.002  # no interpenetration


@pytest.mark.parametrize("name", HANDS)
def test_without_friction_the_same_pinch_drops(name: str) -> None:
    verdict = pinch(hand(name), cube(), LiftConfig(friction=0.02))
    assert not verdict.held
    assert verdict.reason in ("missed", "slipped in the lift", "dropped in the hold")


@pytest.mark.parametrize("name", HANDS)
def test_in_empty_air_it_reports_missed(name: str) -> None:
    assert pinch(hand(name), cube(), LiftConfig(), at=(0.0, 0.0, 0.3)).reason == "missed"


@pytest.mark.parametrize("name", HANDS)
@pytest.mark.parametrize(("friction", "at"), [(0.6, (0.0, 0.0, 0.03)), (0.02, (0.0, 0.0, 0.03)), (0.6, (0.2, 0, 0.3))])
def test_half_the_time_step_gives_the_same_verdict(name: str, friction: float, at: tuple[float, float, float]) -> None:
    whole, half = (pinch(hand(name), cube(), LiftConfig(friction=friction, time_step=dt), at=at) for dt in (2e-3, 1e-3))
    assert (whole.held, whole.reason) == (half.held, half.reason)


@pytest.mark.parametrize(("share", "held"), [(0.8, True), (1.2, False)])
def test_a_pinch_slips_at_the_mass_that_friction_carries(share: float, held: bool) -> None:
    model, friction = hand("franka_hand"), 0.2
    mass = share * 2 * friction * model.card.finger_force / GRAVITY
    assert pinch(model, cube(mass), LiftConfig(friction=friction)).held is held


@pytest.mark.parametrize("name", HANDS)
def test_a_hand_closing_on_nothing_reaches_its_closed_posture(name: str) -> None:
    model = hand(name)
    world = build_world(cube(), model, Physics(0.002, 0.6, 0.005, gravity=False, has_table=False))
    run = Run(world, place(world, np.eye(4), translation(np.array([1.0, 0, 0])), half_open(model)))
    for _ in run.close(1.0, squeeze=0.2):
        pass
    closed, travel = model.card.closed_joints, model.card.closed_joints - model.card.open_joints
    np.testing.assert_allclose(run.data.qpos[world.drive_qpos], closed, atol=0.01 * np.abs(travel).max())


def squeeze_of_a_shaken_cube(integrator: int) -> np.ndarray:
    """Sum of the normal forces on a 1 kg cube in the Franka Hand that is shaken by 2 cm, 2.5 times a second [N]."""
    model = hand("franka_hand")
    physics = Physics(0.002, 1.0, 0.005, integrator=integrator, has_table=False)
    world = build_world(cube(1.0), model, physics)
    run = Run(world, place(world, from_above(model, (0, 0, 0.025)), np.eye(4), half_open(model)))
    world.model.opt.gravity[2] = 0
    for _ in run.close(1.0, squeeze=0.25):
        pass
    world.model.opt.gravity[2] = -GRAVITY
    forces = []
    for i in range(8):
        way = np.array([0.0, 0.02 * (-1) ** i, 0.02 * (-1) ** (i // 2)])
        for _ in run.move(way, 0.2):
            forces.append(touch(world, run.data).press)
    return np.array(forces)


def test_the_squeeze_of_a_shaken_cube_stays_the_rated_force() -> None:
    forces = squeeze_of_a_shaken_cube(int(mujoco.mjtIntegrator.mjINT_DISCRETE))
    # Each finger presses with 40 N; shaking moves force from one finger to the other.
    np.testing.assert_allclose(forces, 80.0, rtol=0.1)


def test_the_rated_force_arrives_at_the_fingertips_of_every_hand() -> None:
    forces = {name: stroke_from(hand(name), hand(name).card.open_joints).force for name in HANDS}
    np.testing.assert_allclose(forces["franka_hand"], 80.0, rtol=1e-6)  # 40 N at each of two fingers on one drive
    for name in ("barrett_bh282", "kinova_kg3"):
        lever = forces[name][0] / hand(name).card.finger_force
        assert 0.08 < lever < 0.16  # m; finger, with the tip that follows


def test_a_finger_of_a_self_locking_hand_is_not_pushed_open() -> None:
    model = hand("barrett_bh282")
    world = build_world(cube(), model, lift_physics(LiftConfig()))
    run = Run(world, place(world, from_above(model, (0, 0, 0.03)), np.eye(4), half_open(model)))
    for _ in run.close(1.0, squeeze=0.2):
        pass
    before = run.data.qpos[world.drive_qpos].copy()
    run.data.qfrc_applied[world.drive_dof[0]] = -3 * run.stroke.force[0]
    for _ in run.wait(0.3):
        pass
    assert abs(run.data.qpos[world.drive_qpos[0]] - before[0]) < 0.01


def lift_from(world: World, start: np.ndarray, end: np.ndarray, config: LiftConfig):
    return lift(world, start, end, half_open(world.hand), np.eye(4), config)


@pytest.mark.parametrize(
    ("at", "reason"),
    [
        ((0.0, 0.0, -0.01), "collision in approach: the hand meets the table"),
        ((0.0, 0.04, 0.06), "collision in approach: the hand presses on the object"),
    ],
)
def test_what_goes_wrong_on_the_way_in_has_a_name(at: tuple[float, float, float], reason: str) -> None:
    target = box((0.05, 0.05, 0.12 if at[1] > 0 else 0.02), 0.4)
    assert pinch(hand("franka_hand"), target, LiftConfig(), at=at).reason == reason


def test_an_object_that_is_pushed_away_on_the_way_in_is_named() -> None:
    model, config = hand("franka_hand"), LiftConfig()
    down = from_above(model, (0, 0, 0.03))
    T = down.copy()
    T[:3, :3] = down[:3, :3] @ rotation_exp(np.array([0.0, np.pi / 2, 0.0]))  # level, closing still along y
    T[:3, 3] = np.array([0.0, 0.0, 0.06]) - T[:3, :3] @ model.card.tool_centre_point
    closed = model.card.closed_joints
    start = T @ translation(-0.15 * model.card.approach)
    world = build_world(box((0.05, 0.05, 0.12), 0.3), model, lift_physics(config))
    verdict = lift(world, start, T, closed, np.eye(4), config)
    assert verdict.reason == "collision in approach: the object is pushed away"
    assert verdict.push > config.largest_push


def test_the_hand_follows_its_way_and_the_object_comes_along() -> None:
    model, config, recording = hand("franka_hand"), LiftConfig(), Recording()
    assert pinch(model, cube(), config, recording=recording).held
    assert recording.phases[0] == "approach"
    assert recording.phases[-1] == "hold"
    rise = recording.T_world_object[-1][2, 3] - recording.T_world_object[0][2, 3]
    assert rise == pytest.approx(config.lift_height, abs=0.005)
    np.testing.assert_allclose(np.diff(recording.times), 1 / recording.frames_per_second, atol=0.003)


def test_placing_puts_hand_and_object_where_they_are_said_to_be() -> None:
    model, rng = hand("kinova_kg3"), np.random.default_rng(0)
    world = build_world(cube(), model, lift_physics(LiftConfig()))
    for _ in range(5):
        T_hand, T_object = (from_parts(rotation_exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(2))
        data = place(world, T_hand, T_object, half_open(model))
        np.testing.assert_allclose(gripper_pose(world, data), T_hand, atol=1e-9)
        np.testing.assert_allclose(object_pose(world, data), T_object, atol=1e-9)


def test_a_trial_leaves_no_trace_in_the_next() -> None:
    model, config = hand("barrett_bh282"), LiftConfig(hold_seconds=0.5)
    world = build_world(cube(), model, lift_physics(config))
    T = from_above(model, (0, 0, 0.03))
    first = lift_from(world, T @ translation(-0.15 * model.card.approach), T, config)
    other = from_above(model, (0.02, 0.01, 0.05))
    lift_from(world, other @ translation(-0.15 * model.card.approach), other, config)
    assert lift_from(world, T @ translation(-0.15 * model.card.approach), T, config) == first


def test_a_tower_stands_a_leaning_one_topples_and_a_bumpy_foot_is_levelled() -> None:
    tower = box((0.04, 0.04, 0.2), 0.3)
    stands = settle(tower, 0.6)
    assert not stands.topples
    assert stands.levelled == 0
    np.testing.assert_allclose(stands.T_world_object, np.eye(4), atol=1e-4)

    lean = rotation_exp(np.array([0.5, 0.0, 0.0]))
    assert settle(transformed_body(tower, lean), 0.6).topples

    bumpy = settle(transformed_body(box((0.03, 0.03, 0.3), 0.3), np.eye(3), bump=0.003), 0.6)
    assert not bumpy.topples
    assert 0 < bumpy.levelled <= 0.005


def transformed_body(target, rotation: np.ndarray, bump: float = 0.0):
    """The body turned about its centre, and with one small foot under its middle."""
    from dataclasses import replace

    from graspmatch.geometry.mesh import TriangleMesh, transformed

    parts = tuple(transformed(part, from_parts(rotation, np.zeros(3))) for part in target.parts)
    if bump:
        foot = np.array([[x, y, z] for x in (1e-3, 3e-3) for y in (-1e-3, 1e-3) for z in (-bump, 0.01)])
        parts += (TriangleMesh(foot, parts[0].faces),)
    return replace(target, parts=parts, centre_of_mass=rotation @ target.centre_of_mass)


@pytest.mark.parametrize("name", HANDS)
def test_six_pushes_are_held_by_a_good_pinch_and_not_tried_on_a_miss(name: str) -> None:
    model, config = hand(name), ForceClosureConfig()
    world = build_world(cube(config.mass), model, force_closure_physics(config))
    T = from_above(model, (0, 0, 0.025))
    away = translation(np.array([0.0, 0.0, 0.4])) @ T
    assert force_closure(world, T, half_open(model), np.eye(4), config).held
    assert force_closure(world, away, half_open(model), np.eye(4), config).reason == "missed"


@pytest.mark.parametrize("name", HANDS)
def test_five_pulls_are_held_by_a_good_pinch_and_not_tried_on_a_miss(name: str) -> None:
    model, config = hand(name), TugConfig()
    world = build_world(cube(config.mass), model, tug_physics(config))
    T = from_above(model, (0, 0, 0.025))
    away = translation(np.array([0.0, 0.0, 0.4])) @ T
    assert tug(world, T, half_open(model), np.eye(4), config).held
    assert tug(world, away, half_open(model), np.eye(4), config).reason == "missed"


def test_a_slippery_cube_is_tugged_out_of_two_fingers() -> None:
    model, slippery = hand("franka_hand"), TugConfig(friction=0.02)
    world = build_world(cube(slippery.mass), model, tug_physics(slippery))
    verdict = tug(world, from_above(model, (0, 0, 0.025)), half_open(model), np.eye(4), slippery)
    assert verdict.reason == "a finger lost the object"


def test_a_push_that_friction_does_not_carry_fails_fc6() -> None:
    model, config = hand("franka_hand"), ForceClosureConfig(friction=0.1, force=10.0)
    world = build_world(cube(config.mass), model, force_closure_physics(config))
    verdict = force_closure(world, from_above(model, (0, 0, 0.025)), half_open(model), np.eye(4), config)
    assert verdict.reason.startswith("moved by a push")


def test_a_hand_inside_the_object_fails_fc6() -> None:
    model, config = hand("franka_hand"), ForceClosureConfig()
    world = build_world(cube(config.mass), model, force_closure_physics(config))
    T = from_above(model, (0, 0.03, 0.0))
    assert force_closure(world, T, half_open(model), np.eye(4), config).reason == "the hand begins inside the object"


def test_only_the_classes_that_may_meet_do() -> None:
    world = build_world(cube(), hand("barrett_bh282"), lift_physics(LiftConfig()))
    data = place(world, np.eye(4), translation(np.array([0, 0, 1.0])), world.hand.card.closed_joints)
    kinds = world.model.geom_contype[data.contact.geom]
    assert np.all((kinds == OBJECT_BIT).any(axis=1) | (kinds == 4).any(axis=1))
