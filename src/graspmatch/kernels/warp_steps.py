"""The steps of Algorithm 1 that a particle takes alone, for CPU and CUDA; `warp_stein` has those of the Stein phase.

Legend as in `warp_match`: i, j particles, g their preshape, p position, q rotation, k iteration.
"""

import warp as wp

from graspmatch.kernels.warp_blocks import lanes
from graspmatch.kernels.warp_collide import FLAGS, Hand, Surroundings
from graspmatch.kernels.warp_fields import NearestField, nearest_index
from graspmatch.kernels.warp_match import NONE, Particles, Terms, slope_at
from graspmatch.kernels.warp_queue import Queue, take

wp.set_module_options({"enable_backward": False, "fast_math": False, "cpu_compiler_flags": FLAGS})


@wp.func
def turn(q: wp.quat, w: wp.vec3) -> wp.quat:
    """The rotation q followed by the rotation vector w, at most half a radian of it."""
    angle = wp.length(w)
    if angle < 1.0e-9:
        return q
    return wp.normalize(wp.quat_from_axis_angle(w / angle, wp.min(angle, 0.5)) * q)


@wp.kernel
def gradients(
    queue: Queue,
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
    batch_offset: wp.array(dtype=wp.int32),
    batch_size: wp.array(dtype=wp.int32),
    iteration: int,
    want_loss: int,
    particles: Particles,
):
    """One gradient pass of one particle."""
    i = take(queue, wp.tid() / lanes())
    if i < 0:
        return
    lane = wp.tid() % lanes()
    g = particles.preshape[i]
    p = particles.position[i]
    q = particles.rotation[i]
    drawn = iteration * hand.count.shape[0] + g
    batch = wp.vec2i(batch_offset[drawn], batch_size[drawn])
    found = slope_at(
        hand,
        samples,
        target,
        nearest,
        goals,
        scene,
        points,
        balls,
        outline,
        levels,
        terms,
        g,
        p,
        q,
        batch,
        want_loss,
        lane,
    )
    if lane == 0:
        particles.gradient_position[i] = found.by_position
        particles.gradient_rotation[i] = found.by_rotation
        particles.matching_error[i] = found.error
        particles.loss[i] = found.loss
        particles.colliding[i] = found.colliding


@wp.kernel
def descend(
    queue: Queue,
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
    batch_offset: wp.array(dtype=wp.int32),
    batch_size: wp.array(dtype=wp.int32),
    iteration: int,
    iterations: int,
    settle_from: int,
    closed_form: int,
    particles: Particles,
):
    """SGD-ICP: so many iterations of eq. (3), theta - eta A g, of one particle, which needs no other for them; in
    closed form those of ICP. The first of them is `iteration`, and the batches of all lie one behind the other. From
    `settle_from` on, where they are whole, a free particle whose loss hardly changes any more has converged, and its
    best pose is remembered."""
    i = take(queue, wp.tid() / lanes())
    if i < 0:
        return
    lane = wp.tid() % lanes()
    if particles.is_converged[i] != 0:
        return
    g = particles.preshape[i]
    p = particles.position[i]
    q = particles.rotation[i]
    previous = particles.loss[i]
    least = particles.best_loss[i]
    is_converged = int(0)
    k = int(0)
    while k < iterations and is_converged == 0:
        drawn = (iteration + k) * hand.count.shape[0] + g
        batch = wp.vec2i(batch_offset[drawn], batch_size[drawn])
        found = slope_at(
            hand, samples, target, nearest, goals, scene, points, balls, outline, levels, terms, g, p, q, batch, 0, lane
        )
        if found.colliding == 0 and k >= settle_from:
            if found.loss < least:
                least = found.loss
                if lane == 0:
                    particles.best_loss[i] = least
                    particles.best_error[i] = found.error
                    particles.best_position[i] = p
                    particles.best_rotation[i] = q
            if wp.abs(previous - found.loss) <= terms.convergence * previous:
                is_converged = 1
        previous = found.loss
        if closed_form != 0 and found.colliding == 0:
            fitted, turned = aligned(hand, target, terms, g, p, q)
            p = fitted
            q = turned
        elif is_converged == 0:
            p = p - terms.learning_rate * found.by_position
            q = turn(q, -terms.learning_rate * found.by_rotation)
        k += 1
    if lane == 0:
        particles.position[i] = p
        particles.rotation[i] = q
        particles.loss[i] = previous
        particles.is_converged[i] = is_converged


@wp.func
def aligned(hand: Hand, target: NearestField, terms: Terms, g: int, p: wp.vec3, q: wp.quat):
    """Eq. (2) in closed form (SVD): the pose that fits the samples to their nearest points."""
    source = wp.vec3(0.0, 0.0, 0.0)
    goal = wp.vec3(0.0, 0.0, 0.0)
    product = wp.mat33(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    mass = float(0.0)
    b = int(0)
    while b <= hand.count[g]:
        s = hand.tool_centre_point[g]
        r = terms.com
        weight = terms.com_weight * mass  # the centre-of-mass pair comes last, and weighs as much as all samples
        if b < hand.count[g]:
            s = hand.samples[hand.start[g] + b]
            r = target.points[nearest_index(target, p + wp.quat_rotate(q, s))]
            weight = hand.weights[hand.start[g] + b]
        source += weight * s
        goal += weight * r
        product += weight * wp.outer(r, s)
        mass += weight
        b += 1
    covariance = product / mass - wp.outer(goal / mass, source / mass)
    U, sigma, V = wp.svd3(covariance)
    mirror = wp.vec3(1.0, 1.0, wp.sign(wp.determinant(U) * wp.determinant(V)))
    R = U * wp.diag(mirror) * wp.transpose(V)
    return goal / mass - R * (source / mass), wp.normalize(wp.quat_from_matrix(R))


@wp.kernel
def take_best(queue: Queue, particles: Particles):
    """The best free pose of a particle and what was found there, where that is not the pose it is at."""
    i = take(queue, wp.tid())
    if i < 0:
        return
    is_worse = particles.colliding[i] != 0 or particles.best_loss[i] < particles.loss[i]
    if is_worse and particles.best_loss[i] < NONE:
        particles.position[i] = particles.best_position[i]
        particles.rotation[i] = particles.best_rotation[i]
        particles.loss[i] = particles.best_loss[i]
        particles.matching_error[i] = particles.best_error[i]
        particles.colliding[i] = 0
