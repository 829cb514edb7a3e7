"""The loss of a match and its gradients, for CPU and CUDA; `warp_steps` has the steps that follow them.

A particle is a pose of one preshape: p, the position of the preshape's pivot (the centre of its inner surface S) in the
object frame, and q, the rotation. Samples s, and x in the fields of the hand, are relative to that pivot. Updates are a
translation of the pivot and a rotation vector w in the object frame: the chart in which the Gauss-Newton matrix of the
matching error is the identity and the inertia of S, which is what the preconditioner A of eq. (3) inverts.

On CUDA a warp works on one particle, each of its lanes on a share of the points; on a CPU one thread has them all.

What is looped over lies in arrays that the kernels get directly, coordinate by coordinate, so that a CPU vectorises the
loops (see `warp_blocks`): `samples`, of each preshape in the order of its mini-batches, first all x, then all y, z and
weights; `goals`, the points of R, likewise; `points`, C in blocks; `outline`, the hands' corners in blocks.

Legend: i particle, g its preshape, R rotation, p its position, r residual, gt and gw gradients, levels the bounds that
`warp_blocks` looks points up in.
"""

import warp as wp

from graspmatch.kernels.warp_blocks import lane_sum, lane_sum_of, lanes
from graspmatch.kernels.warp_collide import FLAGS, Hand, Surroundings, collision_pass
from graspmatch.kernels.warp_fields import NearestField

wp.set_module_options({"enable_backward": False, "fast_math": False, "cpu_compiler_flags": FLAGS})

NONE = wp.constant(1.0e30)
"""Loss of a particle that is not, or never was, free."""


@wp.struct
class Particles:
    """State of the particles, and what the last gradient pass found."""

    preshape: wp.array(dtype=wp.int32)
    position: wp.array(dtype=wp.vec3)
    rotation: wp.array(dtype=wp.quat)
    seed_position: wp.array(dtype=wp.vec3)
    seed_rotation: wp.array(dtype=wp.quat)
    gradient_position: wp.array(dtype=wp.vec3)
    gradient_rotation: wp.array(dtype=wp.vec3)
    matching_error: wp.array(dtype=wp.float32)
    loss: wp.array(dtype=wp.float32)
    colliding: wp.array(dtype=wp.int32)
    is_converged: wp.array(dtype=wp.int32)
    best_loss: wp.array(dtype=wp.float32)
    best_error: wp.array(dtype=wp.float32)
    best_position: wp.array(dtype=wp.vec3)
    best_rotation: wp.array(dtype=wp.quat)


@wp.struct
class Terms:
    """Weights of the terms of eqs. (8), (13) and (16)."""

    com: wp.vec3
    com_weight: float
    com_gradient_weight: float
    repulsion: float
    prior_precision: float
    prior_concentration: float
    learning_rate: float
    convergence: float
    longest_step: float


@wp.struct
class Slope:
    """What one gradient pass finds at a pose."""

    by_position: wp.vec3
    by_rotation: wp.vec3
    error: wp.float32
    loss: wp.float32
    colliding: wp.int32


@wp.func
def matching_pass(
    hand: Hand,
    samples: wp.array(dtype=wp.float32),
    target: NearestField,
    nearest: wp.array(dtype=wp.int32),
    goals: wp.array(dtype=wp.float32),
    g: int,
    p: wp.vec3,
    R: wp.mat33,
    batch: wp.vec2i,
    lane: int,
):
    """Eqs. (1), (14) and the sums of (16) and (17) over a mini-batch: so many samples from its first on, around the end
    of them all. Per component, for the compiler does not vectorise sums of vectors."""
    count = hand.samples.shape[0]
    start = hand.start[g]
    gx, gy, gz = float(0.0), float(0.0), float(0.0)
    wx, wy, wz = float(0.0), float(0.0), float(0.0)
    error = float(0.0)
    mass = float(0.0)
    turn = int(0)
    while turn < 2:  # up to the end of the samples, and from their start
        at = start + batch[0] + lane
        end = start + wp.min(batch[0] + batch[1], hand.count[g])
        if turn == 1:
            at = start + lane
            end = start + batch[0] + batch[1] - hand.count[g]
        while at < end:
            sx, sy, sz = samples[at], samples[count + at], samples[2 * count + at]
            weight = samples[3 * count + at]
            lx = R[0, 0] * sx + R[0, 1] * sy + R[0, 2] * sz
            ly = R[1, 0] * sx + R[1, 1] * sy + R[1, 2] * sz
            lz = R[2, 0] * sx + R[2, 1] * sy + R[2, 2] * sz
            rx, ry, rz, square = nearest_residual(target, nearest, goals, p[0] + lx, p[1] + ly, p[2] + lz)
            gx += weight * rx
            gy += weight * ry
            gz += weight * rz
            wx += weight * (ly * rz - lz * ry)
            wy += weight * (lz * rx - lx * rz)
            wz += weight * (lx * ry - ly * rx)
            error += weight * square
            mass += weight
            at += lanes()
        turn += 1
    share = 1.0 / lane_sum(mass)
    gt = lane_sum_of(wp.vec3(gx, gy, gz))
    gw = lane_sum_of(wp.vec3(wx, wy, wz))
    return share * gt, share * gw, share * lane_sum(error)


@wp.func
def nearest_residual(
    target: NearestField,
    nearest: wp.array(dtype=wp.int32),
    goals: wp.array(dtype=wp.float32),
    x: float,
    y: float,
    z: float,
):
    """From the nearest point of R to (x, y, z), and the square of its length: the best of the candidates that the eight
    nodes around carry, as in `nearest_index`."""
    count = target.points.shape[0]
    scale = 1.0 / target.spacing
    i = wp.min(wp.max(int((x - target.origin[0]) * scale), 0), target.dims[0] - 2)
    j = wp.min(wp.max(int((y - target.origin[1]) * scale), 0), target.dims[1] - 2)
    k = wp.min(wp.max(int((z - target.origin[2]) * scale), 0), target.dims[2] - 2)
    at = (i * target.dims[1] + j) * target.dims[2] + k
    dx = target.dims[1] * target.dims[2]
    dy = target.dims[2]
    rx, ry, rz = float(0.0), float(0.0), float(0.0)
    least = float(1.0e30)
    for corner in range(8):
        c = nearest[at + (corner & 1) + ((corner >> 1) & 1) * dy + (corner >> 2) * dx]
        ax = x - goals[c]
        ay = y - goals[count + c]
        az = z - goals[2 * count + c]
        square = ax * ax + ay * ay + az * az
        is_nearer = square < least
        rx = wp.where(is_nearer, ax, rx)
        ry = wp.where(is_nearer, ay, ry)
        rz = wp.where(is_nearer, az, rz)
        least = wp.where(is_nearer, square, least)
    return rx, ry, rz, least


@wp.func
def slope_at(
    hand: Hand,
    samples: wp.array(dtype=wp.float32),
    target: NearestField,
    nearest: wp.array(dtype=wp.int32),
    goals: wp.array(dtype=wp.float32),
    scene: Surroundings,
    points: wp.array(dtype=wp.float32),
    balls: wp.array(dtype=wp.float32),
    outline: wp.array(dtype=wp.float32),
    levels: wp.array(dtype=wp.int32),
    terms: Terms,
    g: int,
    p: wp.vec3,
    q: wp.quat,
    batch: wp.vec2i,
    want_loss: int,
    lane: int,
) -> Slope:
    """Gradients at a pose: eqs. (16), (17), or (4), (5) of eq. (18) where the hand collides. There the matching has no
    say, and is left out unless its loss is wanted."""
    found = Slope()
    R = wp.quat_to_matrix(q)
    gt, gw, colliding = collision_pass(hand, scene, points, balls, outline, levels, g, p, R, lane)
    found.loss = NONE
    if colliding == 0 or want_loss != 0:
        mt, mw, error = matching_pass(hand, samples, target, nearest, goals, g, p, R, batch, lane)
        lever = R * hand.tool_centre_point[g]
        residual = p + lever - terms.com
        found.error = error
        found.loss = error + terms.com_weight * wp.length_sq(residual)
        if colliding == 0:
            weight = terms.com_gradient_weight
            if weight < 0.0:  # the printed scale: one pair among the m of the batch
                weight = -weight / float(batch[1])
            # A: the inverse Gauss-Newton matrix of what was summed.
            gt = (mt + weight * residual) / (1.0 + weight)
            gw = mw + weight * wp.cross(lever, residual)
    found.by_position = gt
    found.by_rotation = hand_turn(hand, g, R, gw)
    found.colliding = colliding
    return found


@wp.func
def hand_turn(hand: Hand, g: int, R: wp.mat33, w: wp.vec3) -> wp.vec3:
    """The rotational block of A, applied to a gradient in the object frame."""
    return R * (hand.inverse_inertia[g] * (wp.transpose(R) * w))
