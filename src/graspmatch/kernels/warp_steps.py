"""The steps of Algorithm 1 for all particles of all preshapes at once, for CPU and CUDA.

Legend as in `warp_match`: i, j particles, g their preshape, p position, q rotation, k iteration or kernel, h bandwidth.
"""

import warp as wp

from graspmatch.kernels.warp_blocks import lanes
from graspmatch.kernels.warp_collide import FLAGS, Hand, Surroundings
from graspmatch.kernels.warp_fields import NearestField, nearest_index
from graspmatch.kernels.warp_match import NONE, Particles, Terms, hand_turn, slope_at
from graspmatch.kernels.warp_queue import Queue, take

wp.set_module_options({"enable_backward": False, "fast_math": False, "cpu_compiler_flags": FLAGS})


Crowd = wp.types.vector(length=13, dtype=wp.float32)


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
    with_prior: int,
    particles: Particles,
):
    """One gradient pass of one particle; for the Stein phase with the prior around its seed, as in eq. (8)."""
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


@wp.func
def shortened(v: wp.vec3, most: float) -> wp.vec3:
    """The vector, no longer than `most`."""
    return v * wp.min(1.0, most / wp.max(wp.length(v), 1.0e-9))


@wp.func_native("""
    const float* at = (const float*)position.data;
    float x = 0.0f, y = 0.0f, z = 0.0f, square = 0.0f;
    for (int j = begin; j < end; ++j) {
        float a = at[3 * j], b = at[3 * j + 1], c = at[3 * j + 2];
        x += a;
        y += b;
        z += c;
        square += a * a + b * b + c * c;
    }
    float share = 1.0f / (end - begin);
    return share * square - share * share * (x * x + y * y + z * z);
""")
def spread_of(position: wp.array(dtype=wp.vec3), begin: int, end: int) -> float:
    """Mean squared distance of some positions from their mean."""
    ...


@wp.func_native("""
    const float* at = (const float*)position.data;
    const float* turn = (const float*)rotation.data;
    const float* by_t = (const float*)gradient_position.data;
    const float* by_w = (const float*)gradient_rotation.data;
    const float p0 = p[0], p1 = p[1], p2 = p[2], q0 = q[0], q1 = q[1], q2 = q[2], q3 = q[3];
    const float scale = 1.0f / h;
    float dt0 = 0.0f, dt1 = 0.0f, dt2 = 0.0f, dw0 = 0.0f, dw1 = 0.0f, dw2 = 0.0f;
    float at0 = 0.0f, at1 = 0.0f, at2 = 0.0f, aw0 = 0.0f, aw1 = 0.0f, aw2 = 0.0f, mass = 0.0f;
    for (int j = begin; j < end; ++j) {
        float x = p0 - at[3 * j], y = p1 - at[3 * j + 1], z = p2 - at[3 * j + 2];
        float a0 = turn[4 * j], a1 = turn[4 * j + 1], a2 = turn[4 * j + 2], a3 = turn[4 * j + 3];
        float exponent = -scale * (x * x + y * y + z * z);
#if defined(__CUDA_ARCH__)
        float k_t = expf(exponent);
#else
        float power = wp::max(1.442695041f * exponent, -126.0f);  // of two: whole, and a share that a polynomial takes
        int whole = (int)power - 1;
        float f = power - whole;
        float tail = 0.240153617f + f * (0.0558263180f + f * (0.00898934010f + f * 0.00187757667f));
        float k_t = __builtin_bit_cast(float, (whole + 127) << 23) * (0.999999925f + f * (0.693153073f + f * tail));
#endif
        float cosine = a0 * q0 + a1 * q1 + a2 * q2 + a3 * q3;
        float k = k_t * (cosine < 0.0f ? -cosine : cosine);
        float slope = cosine < 0.0f ? -0.5f * k_t : 0.5f * k_t;
        dt0 += k * by_t[3 * j];
        dt1 += k * by_t[3 * j + 1];
        dt2 += k * by_t[3 * j + 2];
        dw0 += k * by_w[3 * j];
        dw1 += k * by_w[3 * j + 1];
        dw2 += k * by_w[3 * j + 2];
        at0 += k * x;
        at1 += k * y;
        at2 += k * z;
        aw0 += slope * (a3 * q0 - q3 * a0 - (q1 * a2 - q2 * a1));
        aw1 += slope * (a3 * q1 - q3 * a1 - (q2 * a0 - q0 * a2));
        aw2 += slope * (a3 * q2 - q3 * a2 - (q0 * a1 - q1 * a0));
        mass += k;
    }
    wp::vec_t<13, float> sums;
    sums[0] = dt0, sums[1] = dt1, sums[2] = dt2, sums[3] = dw0, sums[4] = dw1, sums[5] = dw2;
    sums[6] = 2.0f * scale * at0, sums[7] = 2.0f * scale * at1, sums[8] = 2.0f * scale * at2;
    sums[9] = aw0, sums[10] = aw1, sums[11] = aw2, sums[12] = mass;
    return sums;
""")
def crowd(
    h: float,
    p: wp.vec3,
    q: wp.quat,
    position: wp.array(dtype=wp.vec3),
    rotation: wp.array(dtype=wp.quat),
    gradient_position: wp.array(dtype=wp.vec3),
    gradient_rotation: wp.array(dtype=wp.vec3),
    begin: int,
    end: int,
) -> Crowd:
    """What the particles of a group do to one at (p, q), k being the product of (9) and (10): their gradients weighted
    by k (position, rotation), the gradient of k by the others (position, and as the rotation vector that turns q away
    from theirs, the same for a and -a), and the sum of k. In C++, so that a CPU looks at 8 of them at once."""
    ...


@wp.kernel
def stein(
    queue: Queue,
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
    i = take(queue, wp.tid())
    if i < 0:
        return
    g = particles.preshape[i]
    start = group_start[g]
    count = group_count[g]
    n = float(hand.count[g])
    p = particles.position[i]
    q = particles.rotation[i]
    # Bandwidth by the mean squared distance over log K, the median rule without a sort.
    spread = spread_of(particles.position, start, start + count)
    h = wp.max(2.0 * spread / wp.log(float(count) + 1.0), 1.0e-8)
    sums = crowd(
        h,
        p,
        q,
        particles.position,
        particles.rotation,
        particles.gradient_position,
        particles.gradient_rotation,
        start,
        start + count,
    )
    drift_t = wp.vec3(sums[0], sums[1], sums[2])
    drift_w = wp.vec3(sums[3], sums[4], sums[5])
    away_t = wp.vec3(sums[6], sums[7], sums[8])
    away_w = wp.vec3(sums[9], sums[10], sums[11])
    mass = sums[12]
    move = (-gamma * drift_t + terms.repulsion * inverse_mass(terms) * away_t / n) / mass
    spin = (-gamma * drift_w + terms.repulsion * hand_turn(hand, g, wp.quat_to_matrix(q), away_w) / n) / mass
    position_out[i] = p + shortened(terms.learning_rate * move, terms.longest_step)
    rotation_out[i] = turn(q, terms.learning_rate * spin)
