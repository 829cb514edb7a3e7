"""The planner's stages: known answers, and what must not change when the input moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from graspmatch.config import (
    ClosingConfig,
    CollisionConfig,
    GripConfig,
    MatchingConfig,
    PlannerConfig,
    PoseGaussian,
    RankingConfig,
    SeedingConfig,
)
from graspmatch.geometry import se3
from graspmatch.geometry.grid import Grid, interpolate
from graspmatch.gripper.load import load_gripper
from graspmatch.kernels import launch
from graspmatch.planner.advice import UNSURE, advice
from graspmatch.planner.avoid import (
    keep_free,
    table_clearance,
    table_clearance_of_way,
    upload_space,
    wider_preshapes,
)
from graspmatch.planner.candidates import Candidates, Matched
from graspmatch.planner.close import contact_joints, first_crossing
from graspmatch.planner.match import annealing, batch_share, match, prepare
from graspmatch.planner.plan import KERNELS, plan
from graspmatch.planner.rank import rank
from graspmatch.planner.seed import asked_for, pose_seeds, seed_poses
from graspmatch.planner.tally import Tally
from graspmatch.planner.upload import lowest
from graspmatch.scene.scene import Scene, Table
from graspmatch.scene.shapes import mug
from graspmatch.types import GraspmatchError, Gripper, PointCloud
from toy_hand import COARSE, write_toy

METHODS = ("icp", "sgd-icp", "stein-icp", "annealed-stein-icp")


def box_points(size, centre, spacing=0.002):
    """The surface of a box as points."""
    size = np.asarray(size)
    axes = [np.arange(-s / 2, s / 2 + 1e-9, spacing) for s in size]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    on_surface = np.any(np.abs(np.abs(points) - size / 2) < spacing / 2, axis=-1)
    return points[on_surface] + centre


def box_scene(size=(0.08, 0.03, 0.06), at=(0.3, -0.2), table: Table = "auto") -> Scene:
    return Scene.from_cloud(box_points(size, [*at, size[2] / 2]), table=table)


SMALL = PlannerConfig(seeding=SeedingConfig(points=40, above=6))


def whole_object_hand(toy: Gripper, cloud: np.ndarray) -> Gripper:
    """A 'hand' whose inner surface is the object itself and whose body is nowhere."""
    preshape = toy.preshapes[0]
    nowhere = Grid(preshape.hand.origin, preshape.hand.spacing, np.full_like(preshape.hand.values, 1.0))
    samples = replace(
        preshape,
        samples=PointCloud(cloud),
        weights=np.ones(len(cloud)),
        tool_centre_point=cloud.mean(axis=0),
        hand=nowhere,
        nearest_sample=np.zeros_like(preshape.nearest_sample),
    )
    return replace(toy, preshapes=(samples,))


@pytest.mark.parametrize("method", METHODS)
def test_matching_an_object_to_its_copy_recovers_the_transform(toy, method, device):
    scene = Scene.from_mesh(mug())
    rng = np.random.default_rng(3)
    T_true = se3.from_parts(se3.rotation_exp(np.array([0.5, -0.8, 2.0])), np.array([0.4, 0.1, 0.2]))
    cloud = se3.apply(se3.inverse(T_true), scene.target.points[::7])
    gripper = whole_object_hand(toy, cloud)
    config = MatchingConfig(method=method, com_weight=0.0, iterations=120, voxel_size=0.003)
    problem = prepare(scene, gripper, config, rng, device)
    # Starts turned by up to half a radian about the object's middle, and moved by 2 cm.
    turn = se3.rotation_exp(rng.normal(size=(8, 3)) * 0.25)
    middle = scene.target.points.mean(axis=0)
    about = se3.from_parts(turn, middle - turn @ middle + rng.normal(size=(8, 3)) * 0.01)
    found = match(pose_seeds(about @ T_true, gripper), problem, config, rng)
    best = found.T_world_gripper[np.argmin(found.matching_error)]
    error = se3.inverse(T_true) @ best
    angle = np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))
    offset = np.linalg.norm(se3.apply(best, cloud) - scene.target.points[::7], axis=-1).mean()
    assert np.degrees(angle) < 1.5
    assert offset < 0.0015


def bodiless(gripper: Gripper) -> Gripper:
    """The hand with its inner surface only: nothing that could collide."""
    preshapes = [replace(p, hand=replace(p.hand, values=np.ones_like(p.hand.values))) for p in gripper.preshapes]
    return replace(gripper, preshapes=tuple(preshapes))


@pytest.mark.parametrize("method", METHODS)
def test_every_method_lowers_the_loss_of_its_seeds(toy, method):
    scene, config, rng = box_scene(), MatchingConfig(method=method), np.random.default_rng(0)
    problem = prepare(scene, bodiless(toy), config, rng, "cpu")
    starts = seed_poses(scene, toy, SMALL.seeding, rng)
    matched = match(starts, problem, config, rng)
    before = match(starts, problem, replace(config, iterations=0), rng)
    assert np.median(matched.loss) < 0.5 * np.median(before.loss)


def test_colliding_hands_find_their_way_out(toy):
    """A hand whose fingers stab the box, or the table beside it, is free after matching."""
    scene, config = box_scene(), MatchingConfig(method="sgd-icp")
    down = np.diag([1.0, -1.0, -1.0])
    stabbing = [scene.centre_of_mass + np.array([0, 0.025, 0.08]), [0.3, -0.2, 0.055]]
    starts = Candidates(np.zeros(2, dtype=int), np.stack([se3.from_parts(down, np.array(at)) for at in stabbing]))
    problem = prepare(scene, toy, config, np.random.default_rng(0), "cpu")
    matched = match(starts, problem, config, np.random.default_rng(0))
    for T in matched.T_world_gripper:
        local = se3.apply(se3.inverse(T), scene.target.points)
        assert np.mean(interpolate(toy.preshapes[0].hand, local) < -0.002) < 0.01
        assert se3.apply(T, toy.preshapes[0].outline)[:, 2].min() > -0.004


@pytest.mark.parametrize("choice", [{"batch_from": "object"}, {"com_gradient": "paper"}])
def test_both_readings_of_the_paper_lower_the_loss(toy, choice):
    scene, rng = box_scene(), np.random.default_rng(0)
    config = MatchingConfig(**choice)
    problem = prepare(scene, toy, config, rng, "cpu")
    starts = seed_poses(scene, toy, SMALL.seeding, rng)
    after, before = (match(starts, problem, c, rng) for c in (config, replace(config, iterations=0)))
    assert np.median(after.matching_error) < np.median(before.matching_error)


def test_schedules_are_those_of_table_1():
    config = MatchingConfig()
    assert [annealing(k, config) for k in (0, 4, 8, 12)] == [0.0, 0.25, 0.0, 0.25]
    assert annealing(7, config) == pytest.approx((7 / 8) ** 2)
    assert batch_share(20, config) == pytest.approx(0.75)
    assert batch_share(27, config) == batch_share(40, config) == 1.0
    assert annealing(3, replace(config, method="stein-icp")) == 1.0


def test_seeds_face_the_centre_of_mass_from_the_robots_side(toy):
    scene = box_scene()
    starts = seed_poses(scene, toy, SeedingConfig(), np.random.default_rng(0))
    assert 25 <= len(starts) / len(asked_for(toy)) <= 34  # Table I: about (100 - 6) / 4 + 6
    approach = starts.T_world_gripper[:, :3, :3] @ toy.approach
    tcp = np.array([p.tool_centre_point for p in toy.preshapes])[starts.preshape]
    reach = starts.T_world_gripper[:, :3, 3] + np.einsum("nij,nj->ni", starts.T_world_gripper[:, :3, :3], tcp)
    away = scene.centre_of_mass - reach
    np.testing.assert_allclose(np.cross(away, approach), 0.0, atol=1e-9)
    assert np.all(approach[:, 2] < 0)
    assert np.all(approach[:, 0] > -1e-9)  # the robot is at -x
    straight_down = np.isclose(approach[:, 2], -1)
    assert straight_down.sum() == 6 * len(asked_for(toy))


def test_gaussian_seeds_have_the_mean_and_spread_asked_for(toy):
    gaussian = PoseGaussian((0.1, 0.2, 0.3), (0.0, 1.0, 0.0, 0.0), sigma_position=0.01, sigma_angle=0.1)
    config = SeedingConfig(pattern="gaussians", points=2000, gaussians=(gaussian,))
    starts = seed_poses(box_scene(), toy, config, np.random.default_rng(0))
    own = starts.T_world_gripper[starts.preshape == 0]
    np.testing.assert_allclose(own[:, :3, 3].mean(axis=0), [0.1, 0.2, 0.3], atol=0.001)
    np.testing.assert_allclose(own[:, :3, 3].std(axis=0), 0.01, rtol=0.1)
    cosine = np.einsum("nij,ij->n", own[:, :3, :3], np.diag([1.0, -1.0, -1.0]))
    angle = np.arccos(np.clip((cosine - 1) / 2, -1, 1))
    assert np.sqrt(np.mean(angle**2)) == pytest.approx(0.1 * np.sqrt(3), rel=0.1)


def test_grasps_hold_the_box_between_the_fingers_and_miss_nothing(tmp_path, monkeypatch):
    """A 30 mm box and a hand that opens 60 mm: the fingers end at its sides, each about half a node before it."""
    monkeypatch.setenv("GRASPMATCH_CACHE", str(tmp_path / "cache"))
    fine = replace(COARSE, grid_spacing=0.0025, link_spacing=0.002, fewest_closing_steps=24)
    toy = load_gripper(write_toy(tmp_path), baking=fine)
    scene = box_scene()
    config = replace(SMALL, grip=GripConfig(inexact=1.0), ranking=RankingConfig(least_confidence=0.5))
    several = [plan(scene, toy, replace(config, seed=seed)) for seed in range(4)]
    grasps = several[0]
    assert all(len(some) > 0 for some in several), grasps.explain()
    joints = np.concatenate([some.grasp_joints for some in several])
    gap = 0.06 - 2 * joints[:, 0]  # at the end, the box turned flush where the hand came obliquely
    assert np.median(np.abs(gap - 0.03)) < 1.6 * fine.grid_spacing
    assert gap.min() > 0.026
    assert np.all(grasps.fingers_touching == 2)


def test_no_grasp_comes_nearer_than_the_clearance(toy):
    scene = box_scene()
    grasps = plan(scene, toy, SMALL)
    assert len(grasps) > 0
    assert np.all(grasps.clearance > 0.99 * SMALL.collision.clearance)
    boxes = [
        ((0, 0, -0.01), (0.02, 0.05, 0.01)),
        ((0, 0.035, 0.03), (0.01, 0.005, 0.03)),
        ((0, -0.035, 0.03), (0.01, 0.005, 0.03)),
    ]
    for T, joints in zip(grasps.T_world_gripper, grasps.pregrasp_joints, strict=True):
        for back in (0.0, 0.05, 0.15):
            local = se3.apply(se3.inverse(T), scene.target.points) + back * toy.approach
            for sign, (centre, half) in zip((0, -1, 1), boxes, strict=True):
                q = np.abs(local - np.array(centre) - [0, sign * joints[0], 0]) - half
                assert q.max(axis=-1).min() > 0


def test_grasps_move_with_the_world(toy):
    """Points off the grid by a tenth of a millimetre: on it, rounding decides which of equally near neighbours tell the
    normals at the edges, and with them how well the edges can be held."""
    points = box_points((0.08, 0.03, 0.06), [0.0, 0.0, 0.03])
    points += 1e-4 * np.random.default_rng(0).normal(size=points.shape)
    a, b = Scene.from_cloud(points), Scene.from_cloud(points + np.array([0.7, -0.4, 0.0]))
    first, second = plan(a, toy, SMALL), plan(b, toy, SMALL)
    shift = b.centre_of_mass - a.centre_of_mass
    assert len(first) == len(second) > 0
    moved = first.T_world_gripper.copy()
    moved[:, :3, 3] += shift
    np.testing.assert_allclose(second.T_world_gripper, moved, atol=2e-3)


def test_order_of_the_points_does_not_matter(toy):
    points = box_points((0.08, 0.03, 0.06), [0.0, 0.0, 0.03])
    shuffled = np.random.default_rng(1).permutation(points)
    first, second = (plan(Scene.from_cloud(cloud), toy, SMALL) for cloud in (points, shuffled))
    np.testing.assert_array_equal(first.T_world_gripper, second.T_world_gripper)


def test_same_seed_gives_the_same_bits_for_any_number_of_threads(toy, monkeypatch):
    results = []
    for threads in ("1", "2", "4"):
        monkeypatch.setenv("GRASPMATCH_THREADS", threads)
        results.append(plan(box_scene(), toy, replace(SMALL, seed=11)))
    assert len(results[0]) > 0
    for other in results[1:]:
        np.testing.assert_array_equal(results[0].T_world_gripper, other.T_world_gripper)
        np.testing.assert_array_equal(results[0].score, other.score)


def test_all_that_a_plan_launches_is_loaded_before(toy, monkeypatch):
    monkeypatch.setenv("GRASPMATCH_THREADS", "1")
    launched = set()

    def recording(kernel: wp.Kernel) -> wp.Launch:
        launched.add(kernel.module.name)
        return blank(kernel)

    blank = launch._blank
    monkeypatch.setattr(launch, "_blank", recording)
    plan(box_scene(), toy, PlannerConfig(device="cpu"))
    assert launched == {kernel.module.name for kernel in KERNELS}


def test_another_seed_gives_other_grasps(toy):
    first, second = (plan(box_scene(), toy, replace(SMALL, seed=seed)) for seed in (0, 1))
    assert first.T_world_gripper.shape != second.T_world_gripper.shape or not np.allclose(
        first.T_world_gripper, second.T_world_gripper
    )


def free_mask(scene, toy, poses, config):
    n = len(poses)
    matched = Matched(np.arange(n) % 3, poses, np.zeros(n), np.arange(n, dtype=float), np.ones(n, dtype=bool))
    free = keep_free(matched, upload_space(scene, toy, "cpu"), config, Tally(n))
    return np.isin(np.arange(n), free.loss.astype(int)), free


def test_adding_obstacles_never_frees_a_grasp(toy):
    rng = np.random.default_rng(7)
    scene = box_scene()
    blocked = replace(scene, obstacles=PointCloud(rng.uniform([0.2, -0.3, 0], [0.4, -0.1, 0.2], size=(300, 3))))
    R = se3.matrix_from_quaternion(se3.random_quaternions(400, rng))
    poses = se3.from_parts(R, scene.centre_of_mass + rng.normal(size=(400, 3)) * 0.06)
    config = CollisionConfig(may_open=False)
    before, free = free_mask(scene, toy, poses, config)
    after, still_free = free_mask(blocked, toy, poses, config)
    assert before.sum() > after.sum() > 0
    assert not np.any(after & ~before)
    kept = np.isin(free.loss, still_free.loss)
    assert np.all(still_free.retreat >= free.retreat[kept] - 1e-9)


def test_hand_above_the_table_by_its_lowest_corner(toy):
    scene = box_scene()
    grasps = plan(scene, toy, SMALL)
    assert len(grasps) > 0
    for T, preshape in zip(grasps.T_world_gripper, grasps.preshape, strict=True):
        lowest = se3.apply(T, toy.preshapes[preshape].outline)[:, 2].min()
        assert lowest > 0.99 * SMALL.collision.clearance


def test_lowest_corners_along_directions():
    rng = np.random.default_rng(0)
    corners, preshape = rng.normal(size=(3, 2, 9, 3)), rng.integers(3, size=20)
    up = rng.normal(size=(20, 3))
    expected = [[min(up[i] @ corner for corner in part) for part in corners[p]] for i, p in enumerate(preshape)]
    np.testing.assert_allclose(lowest(corners, preshape, up), expected, atol=1e-12)
    np.testing.assert_allclose(lowest(corners[:, 0], preshape, up), np.array(expected)[:, 0], atol=1e-12)


def test_way_in_is_as_high_as_the_lower_of_its_ends(toy):
    rng = np.random.default_rng(0)
    space = upload_space(box_scene(), toy, "cpu")
    turn = Rotation.from_rotvec(rng.normal(size=(30, 3))).as_matrix()
    ways = Candidates(rng.integers(len(toy.preshapes), size=30), se3.from_parts(turn, rng.normal(size=(30, 3)) * 0.2))
    starts = replace(ways, T_world_gripper=ways.T_world_gripper @ toy.T_gripper_pregrasp)
    ends = np.stack([table_clearance(some, space) for some in (ways, starts)])
    np.testing.assert_allclose(table_clearance_of_way(ways, space), ends.min(axis=0), atol=1e-12)
    assert 0 < (ends[0] < ends[1]).sum() < 30


def test_wider_preshape_is_the_next_one_open(toy):
    names = [preshape.name for preshape in toy.preshapes]
    tips = ["fingertips_60mm", "fingertips_30mm", "fingertips_15mm"]
    assert names == ["close_0", "close_30", "close_60", *tips]
    assert wider_preshapes(toy).tolist() == [-1, 0, 1, -1, 1, 2]


def test_fingers_that_share_a_drive_stop_at_the_mean_of_their_contacts(toy):
    joints = contact_joints(np.array([0]), np.array([[0.2, 0.6]]), toy)
    assert joints[0, 0] == pytest.approx(0.4 * 0.03)


def test_finger_that_misses_does_not_count_in_the_mean(toy):
    joints = contact_joints(np.array([0]), np.array([[0.3, 2.0]]), toy)
    assert joints[0, 0] == pytest.approx(0.3 * 0.03)


def test_fingers_reach_the_table_where_their_path_crosses_it():
    heights = np.array([[0.03, 0.01, -0.01, -0.03], [0.1, 0.1, 0.1, 0.1], [-0.01, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(first_crossing(heights), [0.5, 2.0, 0.0])


def test_ranking_keeps_the_better_of_two_like_poses(toy):
    T = np.tile(np.eye(4), (3, 1, 1))
    T[1, 0, 3], T[2, 0, 3] = 0.005, 0.1
    tally = Tally(3)
    order = rank(Candidates(np.zeros(3, dtype=int), T), np.array([0.5, 0.9, 0.2]), RankingConfig(), tally, "no place")
    assert order.tolist() == [1, 2]
    assert tally.counts == {"candidates": 3, "much like a better one": 1, "no place": 0}


def test_plate_flat_on_the_table_is_explained(toy):
    plate = box_points((0.2, 0.2, 0.001), [0, 0, 0.0005])
    grasps = plan(Scene.from_cloud(plate), toy, replace(SMALL, ranking=RankingConfig(least_confidence=0.5)))
    assert len(grasps) == 0
    assert grasps.T_world_gripper.shape == (0, 4, 4)
    assert grasps.grasp_joints.shape == (0, 1)
    text = grasps.explain()
    assert text.startswith("0 grasps for toy from")
    assert "fingers that close on nothing" in text
    assert grasps.advice
    assert grasps.advice in text


def test_advice_names_the_opening_where_the_object_does_not_fit(toy):
    tally = Tally(10)
    tally.keep(np.zeros(9, dtype=bool), "in collision with object or obstacles on the way in")
    assert "toy opens 60 mm" in advice(tally, box_scene(), toy)


def test_advice_tells_how_wide_an_object_is_that_fits_no_way(toy):
    text = advice(Tally(10), box_scene(size=(0.1, 0.12, 0.14)), toy)
    assert "at least 100 mm wide" in text
    assert "toy opens 60 mm" in text


def test_what_is_unlikely_to_hold_is_no_grasp_unless_it_is_asked_for(toy):
    scene, every = box_scene(), replace(SMALL, ranking=RankingConfig(count=100, least_confidence=0.0))
    grasps = plan(scene, toy, every)
    likely = plan(scene, toy, replace(every, ranking=RankingConfig(count=100, least_confidence=0.9)))
    assert 0 < len(likely) < len(grasps)
    assert likely.score.min() >= 0.9 > grasps.score.min()
    assert likely.tally[UNSURE] > 0


def test_tally_accounts_for_every_candidate(toy):
    grasps = plan(box_scene(), toy, SMALL)
    dropped = sum(count for reason, count in grasps.tally.items() if reason != "candidates")
    assert grasps.tally["candidates"] == dropped + len(grasps)


def test_starting_poses_of_the_user_are_refined(toy):
    scene = box_scene()
    T = se3.from_parts(np.diag([1.0, -1.0, -1.0]), scene.centre_of_mass + np.array([0.01, 0.005, 0.1]))
    grasps = plan(scene, toy, SMALL, starts_world_gripper=T[None])
    assert grasps.tally["candidates"] == len(asked_for(toy))
    assert len(grasps) > 0, grasps.explain()
    assert grasps.T_world_gripper[0, 2, 2] < -0.5  # still from above


def test_empty_set_of_starting_poses_is_an_error(toy):
    with pytest.raises(GraspmatchError, match="the set given is empty"):
        plan(box_scene(), toy, SMALL, starts_world_gripper=np.zeros((0, 4, 4)))


@pytest.mark.parametrize("spoil", [np.nan, 2.0, 1e30])
def test_starting_pose_that_is_no_pose_is_an_error(toy, spoil):
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 0] = spoil
    with pytest.raises(GraspmatchError, match="1 of 2 starting poses are no finite rigid transforms"):
        plan(box_scene(), toy, SMALL, starts_world_gripper=poses)


def test_without_a_table_the_hand_comes_from_the_sensors_side(toy):
    cloud = box_points((0.08, 0.03, 0.06), [0.0, 0.0, 0.6])  # camera frame: z forward
    grasps = plan(Scene.from_cloud(cloud, sensor_origin=[0.0, 0.0, 0.0]), toy, SMALL)
    assert len(grasps) > 0
    approach = grasps.T_world_gripper[:, :3, :3] @ toy.approach
    assert np.mean(approach[:, 2]) > 0.25  # matching may turn a hand around the object's edge
    assert approach[0, 2] > 0
    assert approach[0, 2] > 0.5


def test_world_turned_about_the_vertical_turns_the_seeds(toy):
    angle = 0.7
    turn = se3.rotation_exp(np.array([0.0, 0.0, angle]))
    cloud = box_points((0.08, 0.03, 0.06), [0.0, 0.0, 0.03])
    a, b = Scene.from_cloud(cloud), Scene.from_cloud(cloud @ turn.T)
    robot = (-np.cos(angle), -np.sin(angle), 0.0)
    first = seed_poses(a, toy, SMALL.seeding, np.random.default_rng(0))
    second = seed_poses(b, toy, replace(SMALL.seeding, robot_direction=robot), np.random.default_rng(0))
    expected = turn @ first.T_world_gripper[:, :3, :3]
    np.testing.assert_allclose(second.T_world_gripper[:, :3, :3], expected, atol=1e-9)
    offset = second.T_world_gripper[:, :3, 3] - first.T_world_gripper[:, :3, 3] @ turn.T
    assert np.abs(offset).max() < 0.003  # the clouds are thinned on grids that did not turn


@pytest.mark.parametrize(
    "config",
    [
        replace(SMALL, seed=-1),
        replace(SMALL, matching=MatchingConfig(voxel_size=0.0)),
        replace(SMALL, matching=MatchingConfig(learning_rate=float("nan"))),
        replace(SMALL, ranking=RankingConfig(count=-1)),
        replace(SMALL, closing=ClosingConfig(fewest_fingers=5)),
        replace(SMALL, seeding=SeedingConfig(points=0, above=0)),
    ],
)
def test_values_that_make_no_sense_are_errors_that_name_them(toy, config):
    with pytest.raises(GraspmatchError, match=r"seed|voxel_size|learning_rate|count|fewest_fingers|starting poses"):
        plan(box_scene(), toy, config)


def test_missing_device_is_an_error_that_lists_the_present_ones(toy):
    with pytest.raises(GraspmatchError, match=r"No device named 'cuda:99'\. Available: cpu"):
        plan(box_scene(), toy, replace(SMALL, device="cuda:99"))
