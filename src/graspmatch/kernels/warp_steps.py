"""The steps of Algorithm 1 for all particles of all preshapes at once, for CPU and CUDA.

Legend as in `warp_match`: i, j particles, g their preshape, p position, q rotation, k iteration or kernel, h bandwidth.
"""

import warp as wp

from graspmatch.kernels.warp_blocks import lanes
from graspmatch.kernels.warp_fields import NearestField, nearest_index
from graspmatch.kernels.warp_match import FLAGS, NONE, Hand, Particles, Surroundings, Terms, hand_turn, slope_at

wp.set_module_options({"enable_backward": False, "fast_math": False, "cpu_compiler_flags": FLAGS})


@wp.func
def turn(q: wp.quat, w: wp.vec3) -> wp.quat:
    """The rotation q followed by the rotation vector w, at most half a radian of it."""
    angle = wp.length(w)
    if angle < 1.0e-9:
        return q
    return wp.normalize(wp.quat_from_axis_angle(w / angle, wp.min(angle, 0.5)) * q)


@wp.func
def inverse_mass(terms: Terms) -> float:
    """The translational block of A."""
    return 1.0 / (1.0 + wp.max(terms.com_gradient_weight, 0.0))


@wp.func
def prior_slope(seed: wp.quat, q: wp.quat) -> wp.vec3:
    """Gradient of -cos(angle), the negative log of a von Mises prior around the seed: sin(angle) axis."""
    d = q * wp.quat_inverse(seed)
    return 2.0 * d[3] * wp.vec3(d[0], d[1], d[2])


@wp.kernel
def gradients(
    first: int,
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
    with_prior: int,
    particles: Particles,
):
    """One gradient pass of one particle; for the Stein phase with the prior around its seed, as in eq. (8)."""
    i = first + wp.tid() / lanes()
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
    by_position = found.by_position
    by_rotation = found.by_rotation
    if with_prior != 0:
        n = float(hand.count[g])
        by_position += terms.prior_precision * inverse_mass(terms) / n * (p - particles.seed_position[i])
        by_w = terms.prior_concentration / n * prior_slope(particles.seed_rotation[i], q)
        by_rotation += hand_turn(hand, g, wp.quat_to_matrix(q), by_w)
    if lane == 0:
        particles.gradient_position[i] = by_position
        particles.gradient_rotation[i] = by_rotation
        particles.matching_error[i] = found.error
        particles.loss[i] = found.loss
        particles.colliding[i] = found.colliding


@wp.kernel
def descend(
    first: int,
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
    i = first + wp.tid() / lanes()
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
def take_best(first: int, particles: Particles):
    """The best free pose of a particle and what was found there, where that is not the pose it is at."""
    i = first + wp.tid()
    is_worse = particles.colliding[i] != 0 or particles.best_loss[i] < particles.loss[i]
    if is_worse and particles.best_loss[i] < NONE:
        particles.position[i] = particles.best_position[i]
        particles.rotation[i] = particles.best_rotation[i]
        particles.loss[i] = particles.best_loss[i]
        particles.matching_error[i] = particles.best_error[i]
        particles.colliding[i] = 0


@wp.func
def kernel_slope(a: wp.quat, b: wp.quat) -> wp.vec3:
    """Gradient of |a . b| (10) along the sphere by a, as the rotation vector that it turns b by: away from a, the same
    for a and -a, zero where they agree."""
    d = b * wp.quat_inverse(a)
    return 0.5 * wp.sign(d[3]) * wp.vec3(d[0], d[1], d[2])


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
    j = start
    while j < start + count:
        mean += particles.position[j] / float(count)
        square += wp.length_sq(particles.position[j]) / float(count)
        j += 1
    # Bandwidth by the mean squared distance over log K, the median rule without a sort.
    h = wp.max(2.0 * (square - wp.length_sq(mean)) / wp.log(float(count) + 1.0), 1.0e-8)
    drift_t = wp.vec3(0.0, 0.0, 0.0)
    drift_w = wp.vec3(0.0, 0.0, 0.0)
    away_t = wp.vec3(0.0, 0.0, 0.0)
    away_w = wp.vec3(0.0, 0.0, 0.0)
    mass = float(0.0)
    j = start
    while j < start + count:
        apart = p - particles.position[j]
        k_t = wp.exp(-wp.length_sq(apart) / h)
        k = k_t * wp.abs(wp.dot(particles.rotation[j], q))
        drift_t += k * particles.gradient_position[j]
        drift_w += k * particles.gradient_rotation[j]
        away_t += (2.0 / h) * k * apart
        away_w += k_t * kernel_slope(particles.rotation[j], q)
        mass += k
        j += 1
    move = (-gamma * drift_t + terms.repulsion * inverse_mass(terms) * away_t / n) / mass
    spin = (-gamma * drift_w + terms.repulsion * hand_turn(hand, g, wp.quat_to_matrix(q), away_w) / n) / mass
    position_out[i] = p + shortened(terms.learning_rate * move, terms.longest_step)
    rotation_out[i] = turn(q, terms.learning_rate * spin)
