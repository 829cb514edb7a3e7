"""One iteration of Algorithm 1 for all particles of all preshapes at once, for CPU and CUDA.

A particle is a pose of one preshape: p, the position of the preshape's pivot (the centre of its inner surface S) in the
object frame, and q, the rotation. Samples s, and x in the fields of the hand, are relative to that pivot. Updates are a
translation of the pivot and a rotation vector w in the object frame: the chart in which the Gauss-Newton matrix of the
matching error is the identity and the inertia of S, which is what the preconditioner A of eq. (3) inverts.

Legend: i particle, g its preshape, R rotation, r point of the object, c centre of mass, gt and gw gradients.
"""

import warp as wp

from graspmatch.kernels.warp_fields import FieldStack, NearestField, interpolate, is_inside, nearest_index, node_units

wp.set_module_options({"enable_backward": False, "fast_math": False})

NONE = 1.0e30
"""Loss of a particle that never was free."""


@wp.struct
class Hand:
    """What the matching asks of all preshapes: samples one behind the other, fields as stacks."""

    samples: wp.array(dtype=wp.vec3)
    weights: wp.array(dtype=wp.float32)
    start: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)
    tool_centre_point: wp.array(dtype=wp.vec3)
    inverse_inertia: wp.array(dtype=wp.mat33)
    distance: FieldStack
    nearest_sample: wp.array(dtype=wp.int32)
    outline: wp.array(dtype=wp.vec3)
    outline_start: wp.array(dtype=wp.int32)
    outline_count: wp.array(dtype=wp.int32)


@wp.struct
class Surroundings:
    """C of the paper: points of the target, then those of obstacles, and the table as the plane normal . x = offset."""

    points: wp.array(dtype=wp.vec3)
    targets: wp.int32
    normal: wp.vec3
    offset: wp.float32
    has_table: wp.int32


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


@wp.func
def matching_pass(
    hand: Hand,
    shuffled: wp.array(dtype=wp.int32),
    target: NearestField,
    g: int,
    p: wp.vec3,
    q: wp.quat,
    offset: int,
    size: int,
):
    """Eqs. (1), (14) and the sums of (16) and (17) over a mini-batch: `size` of the shuffled samples from `offset`."""
    gt = wp.vec3(0.0, 0.0, 0.0)
    gw = wp.vec3(0.0, 0.0, 0.0)
    error = float(0.0)
    mass = float(0.0)
    count = hand.count[g]
    for b in range(size):
        at = hand.start[g] + shuffled[hand.start[g] + (offset + b) % count]
        lever = wp.quat_rotate(q, hand.samples[at])
        residual = p + lever - target.points[nearest_index(target, p + lever)]
        weight = hand.weights[at]
        gt += weight * residual
        gw += weight * wp.cross(lever, residual)
        error += weight * wp.length_sq(residual)
        mass += weight
    return gt / mass, gw / mass, error / mass


@wp.func
def collision_pass(hand: Hand, scene: Surroundings, g: int, p: wp.vec3, q: wp.quat):
    """Eqs. (12) and (18): the scene in the hand's frame, its points inside the hand, and the pull of a surface of the
    hand towards each. For the target it is the inner surface, so that the object ends up between the fingers. Obstacles
    and table must get out of the hand where they came in: the nearest surface, the corner that is below."""
    gt = wp.vec3(0.0, 0.0, 0.0)
    gw = wp.vec3(0.0, 0.0, 0.0)
    colliding = int(0)
    dims = hand.distance.dims[g]
    for c in range(scene.points.shape[0]):
        x = wp.quat_rotate_inv(q, scene.points[c] - p)
        u = node_units(hand.distance, g, x)
        depth = float(0.0)
        if is_inside(u, dims):
            depth = -interpolate(hand.distance, g, x)
        if depth > 0.0:
            s = x
            if c < scene.targets:
                node = (int(u[0] + 0.5) * dims[1] + int(u[1] + 0.5)) * dims[2] + int(u[2] + 0.5)
                s = hand.samples[hand.start[g] + hand.nearest_sample[hand.distance.start[g] + node]]
            else:
                s = x + depth * outwards(hand.distance, g, x)
            lever = wp.quat_rotate(q, s)
            residual = p + lever - scene.points[c]
            gt += residual
            gw += wp.cross(lever, residual)
            colliding += 1
    if scene.has_table != 0:
        for v in range(hand.outline_count[g]):
            lever = wp.quat_rotate(q, hand.outline[hand.outline_start[g] + v])
            height = wp.dot(scene.normal, p + lever) - scene.offset
            if height < 0.0:
                gt += height * scene.normal
                gw += height * wp.cross(lever, scene.normal)
                colliding += 1
    scale = 1.0 / float(wp.max(colliding, 1))
    return scale * gt, scale * gw, colliding


@wp.func
def outwards(stack: FieldStack, g: int, x: wp.vec3) -> wp.vec3:
    """Direction in which a distance field grows."""
    h = 0.5 * stack.spacing
    dx = wp.vec3(h, 0.0, 0.0)
    dy = wp.vec3(0.0, h, 0.0)
    dz = wp.vec3(0.0, 0.0, h)
    return wp.normalize(
        wp.vec3(
            interpolate(stack, g, x + dx) - interpolate(stack, g, x - dx),
            interpolate(stack, g, x + dy) - interpolate(stack, g, x - dy),
            interpolate(stack, g, x + dz) - interpolate(stack, g, x - dz),
        )
    )


@wp.kernel
def gradients(
    first: int,
    hand: Hand,
    shuffled: wp.array(dtype=wp.int32),
    target: NearestField,
    scene: Surroundings,
    terms: Terms,
    batch_offset: wp.array(dtype=wp.int32),
    batch_size: wp.array(dtype=wp.int32),
    settle: int,
    remember: int,
    particles: Particles,
):
    """Gradients of one particle: eqs. (16), (17), or (4), (5) of eq. (18) where it collides."""
    i = first + wp.tid()
    if particles.is_converged[i] != 0:
        return
    g = particles.preshape[i]
    p = particles.position[i]
    q = particles.rotation[i]
    size = batch_size[g]
    gt, gw, error = matching_pass(hand, shuffled, target, g, p, q, batch_offset[g], size)
    lever = wp.quat_rotate(q, hand.tool_centre_point[g])
    residual = p + lever - terms.com
    loss = error + terms.com_weight * wp.length_sq(residual)
    weight = terms.com_gradient_weight
    if weight < 0.0:  # the printed scale: one pair among the m of the batch
        weight = -weight / float(size)
    # A: the inverse Gauss-Newton matrix of what was summed.
    gt = (gt + weight * residual) / (1.0 + weight)
    gw += weight * wp.cross(lever, residual)
    ct, cw, colliding = collision_pass(hand, scene, g, p, q)
    if colliding > 0:
        gt = ct
        gw = cw
    elif settle != 0:
        previous = particles.loss[i]
        if wp.abs(previous - loss) <= terms.convergence * previous:
            particles.is_converged[i] = 1
    if remember != 0 and colliding == 0 and loss < particles.best_loss[i]:
        particles.best_loss[i] = loss
        particles.best_position[i] = p
        particles.best_rotation[i] = q
    particles.gradient_position[i] = gt
    particles.gradient_rotation[i] = wp.quat_rotate(q, hand.inverse_inertia[g] * wp.quat_rotate_inv(q, gw))
    particles.matching_error[i] = error
    particles.loss[i] = loss
    particles.colliding[i] = colliding


@wp.kernel
def take_best(first: int, particles: Particles):
    """Go back to the best free pose, where there was one."""
    i = first + wp.tid()
    if particles.best_loss[i] < NONE:
        particles.position[i] = particles.best_position[i]
        particles.rotation[i] = particles.best_rotation[i]


@wp.func
def turn(q: wp.quat, w: wp.vec3) -> wp.quat:
    """The rotation q followed by the rotation vector w, at most half a radian of it."""
    angle = wp.length(w)
    if angle < 1.0e-9:
        return q
    return wp.normalize(wp.quat_from_axis_angle(w / angle, wp.min(angle, 0.5)) * q)


@wp.kernel
def descend(first: int, terms: Terms, particles: Particles):
    """Eq. (3): theta - eta A g."""
    i = first + wp.tid()
    if particles.is_converged[i] != 0:
        return
    particles.position[i] = particles.position[i] - terms.learning_rate * particles.gradient_position[i]
    particles.rotation[i] = turn(particles.rotation[i], -terms.learning_rate * particles.gradient_rotation[i])


@wp.func
def kernel_slope(a: wp.quat, b: wp.quat) -> wp.vec3:
    """Gradient of |a . b| (10) along the sphere by a, as the rotation vector that it turns b by: away from a, the same
    for a and -a, zero where they agree."""
    d = b * wp.quat_inverse(a)
    return 0.5 * wp.sign(d[3]) * wp.vec3(d[0], d[1], d[2])


@wp.func
def prior_slope(seed: wp.quat, q: wp.quat) -> wp.vec3:
    """Gradient of -cos(angle), the negative log of a von Mises prior around the seed: sin(angle) axis."""
    d = q * wp.quat_inverse(seed)
    return 2.0 * d[3] * wp.vec3(d[0], d[1], d[2])


@wp.func
def shortened(v: wp.vec3, most: float) -> wp.vec3:
    """The vector, no longer than `most`."""
    return v * wp.min(1.0, most / wp.max(wp.length(v), 1.0e-9))


@wp.kernel
def stein(
    first: int,
    gamma: float,
    terms: Terms,
    hand: Hand,
    group_start: wp.array(dtype=wp.int32),
    group_count: wp.array(dtype=wp.int32),
    particles: Particles,
    position_out: wp.array(dtype=wp.vec3),
    rotation_out: wp.array(dtype=wp.quat),
):
    """Eqs. (7), (8): each particle moves along the kernel-weighted gradients of its preshape's particles and away from
    them, k being the product of (9) and (10). Dividing by the kernel's mass makes eta = 1 a Gauss-Newton step both for
    a lone particle and in a crowd."""
    i = first + wp.tid()
    g = particles.preshape[i]
    start = group_start[g]
    count = group_count[g]
    n = float(hand.count[g])
    p = particles.position[i]
    q = particles.rotation[i]
    mean = wp.vec3(0.0, 0.0, 0.0)
    square = float(0.0)
    for j in range(start, start + count):
        mean += particles.position[j] / float(count)
        square += wp.length_sq(particles.position[j]) / float(count)
    # Bandwidth by the mean squared distance over log K, the median rule without a sort.
    h = wp.max(2.0 * (square - wp.length_sq(mean)) / wp.log(float(count) + 1.0), 1.0e-8)
    inverse_t = 1.0 / (1.0 + wp.max(terms.com_gradient_weight, 0.0))  # the translational block of A
    drift_t = wp.vec3(0.0, 0.0, 0.0)
    drift_w = wp.vec3(0.0, 0.0, 0.0)
    away_t = wp.vec3(0.0, 0.0, 0.0)
    away_w = wp.vec3(0.0, 0.0, 0.0)
    mass = float(0.0)
    for j in range(start, start + count):
        apart = p - particles.position[j]
        k_t = wp.exp(-wp.length_sq(apart) / h)
        k = k_t * wp.abs(wp.dot(particles.rotation[j], q))
        prior_t = terms.prior_precision * (particles.position[j] - particles.seed_position[j])
        prior_w = terms.prior_concentration * prior_slope(particles.seed_rotation[j], particles.rotation[j])
        drift_t += k * (particles.gradient_position[j] + inverse_t * prior_t / n)
        drift_w += k * (particles.gradient_rotation[j] + hand_turn(hand, g, particles.rotation[j], prior_w) / n)
        away_t += (2.0 / h) * k * apart
        away_w += k_t * kernel_slope(particles.rotation[j], q)
        mass += k
    move = (-gamma * drift_t + terms.repulsion * inverse_t * away_t / n) / mass
    spin = (-gamma * drift_w + terms.repulsion * hand_turn(hand, g, q, away_w) / n) / mass
    position_out[i] = p + shortened(terms.learning_rate * move, terms.longest_step)
    rotation_out[i] = turn(q, terms.learning_rate * spin)


@wp.func
def hand_turn(hand: Hand, g: int, q: wp.quat, w: wp.vec3) -> wp.vec3:
    """The rotational block of A, applied to a gradient in the object frame."""
    return wp.quat_rotate(q, hand.inverse_inertia[g] * wp.quat_rotate_inv(q, w))


@wp.kernel
def align(first: int, hand: Hand, target: NearestField, terms: Terms, particles: Particles):
    """Eq. (2) in closed form (SVD) for one particle; one that collides follows its collision gradient instead."""
    i = first + wp.tid()
    if particles.is_converged[i] != 0:
        return
    g = particles.preshape[i]
    p = particles.position[i]
    q = particles.rotation[i]
    if particles.colliding[i] > 0:
        particles.position[i] = p - particles.gradient_position[i]
        particles.rotation[i] = turn(q, -particles.gradient_rotation[i])
        return
    source = wp.vec3(0.0, 0.0, 0.0)
    goal = wp.vec3(0.0, 0.0, 0.0)
    product = wp.mat33(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    mass = float(0.0)
    for b in range(hand.count[g] + 1):
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
    covariance = product / mass - wp.outer(goal / mass, source / mass)
    U, sigma, V = wp.svd3(covariance)
    mirror = wp.vec3(1.0, 1.0, wp.sign(wp.determinant(U) * wp.determinant(V)))
    R = U * wp.diag(mirror) * wp.transpose(V)
    particles.rotation[i] = wp.normalize(wp.quat_from_matrix(R))
    particles.position[i] = goal / mass - R * (source / mass)
