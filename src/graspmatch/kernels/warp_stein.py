"""The Stein phase of Algorithm 1 for all particles of all preshapes at once, for CPU and CUDA.

Legend as in `warp_match`: i, j particles, g their preshape, p position, q rotation, k iteration or kernel, h bandwidth.
"""

import warp as wp

from graspmatch.kernels.warp_blocks import lanes
from graspmatch.kernels.warp_collide import FLAGS, Hand, Surroundings
from graspmatch.kernels.warp_fields import NearestField
from graspmatch.kernels.warp_match import Particles, Terms, hand_turn, slope_at
from graspmatch.kernels.warp_queue import Queue, take
from graspmatch.kernels.warp_steps import turn

wp.set_module_options({"enable_backward": False, "fast_math": False, "cpu_compiler_flags": FLAGS})


Crowd = wp.types.vector(length=13, dtype=wp.float32)


@wp.func
def inverse_mass(terms: Terms) -> float:
    """The translational block of A."""
    return 1.0 / (1.0 + wp.max(terms.com_gradient_weight, 0.0))


@wp.func
def prior_slope(seed: wp.quat, q: wp.quat) -> wp.vec3:
    """Gradient of -cos(angle), the negative log of a von Mises prior around the seed: sin(angle) axis."""
    d = q * wp.quat_inverse(seed)
    return 2.0 * d[3] * wp.vec3(d[0], d[1], d[2])


@wp.func
def shortened(v: wp.vec3, most: float) -> wp.vec3:
    """The vector, no longer than `most`."""
    return v * wp.min(1.0, most / wp.max(wp.length(v), 1.0e-9))


@wp.func_native("""
    const float* at = (const float*)position.data;
    float x = 0.0f, y = 0.0f, z = 0.0f, square = 0.0f;
#if defined(__CUDA_ARCH__)
    const int lanes = 32;
#else
    const int lanes = 1;
#endif
    for (int j = begin + lane; j < end; j += lanes) {
        float a = at[3 * j], b = at[3 * j + 1], c = at[3 * j + 2];
        x += a;
        y += b;
        z += c;
        square += a * a + b * b + c * c;
    }
#if defined(__CUDA_ARCH__)
    for (int apart = 16; apart > 0; apart /= 2) {
        x += __shfl_xor_sync(0xffffffffu, x, apart);
        y += __shfl_xor_sync(0xffffffffu, y, apart);
        z += __shfl_xor_sync(0xffffffffu, z, apart);
        square += __shfl_xor_sync(0xffffffffu, square, apart);
    }
#endif
    float share = 1.0f / (end - begin);
    return share * square - share * share * (x * x + y * y + z * z);
""")
def spread_of(position: wp.array(dtype=wp.vec3), begin: int, end: int, lane: int) -> float:
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
#if defined(__CUDA_ARCH__)
    const int lanes = 32;
#else
    const int lanes = 1;
#endif
    for (int j = begin + lane; j < end; j += lanes) {
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
#if defined(__CUDA_ARCH__)
    for (int c = 0; c < 13; ++c)
        for (int apart = 16; apart > 0; apart /= 2) sums[c] += __shfl_xor_sync(0xffffffffu, sums[c], apart);
#endif
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
    lane: int,
) -> Crowd:
    """What the particles of a group do to one at (p, q), k being the product of (9) and (10): their gradients weighted
    by k (position, rotation), the gradient of k by the others (position, and as the rotation vector that turns q away
    from theirs, the same for a and -a), and the sum of k. In C++, so that a CPU looks at 8 of them at once."""
    ...


@wp.func
def stein_step(hand: Hand, terms: Terms, gamma: float, particles: Particles, i: int, start: int, count: int, lane: int):
    """Eqs. (7), (8): where a particle moves to along the kernel-weighted gradients of its preshape's particles and away
    from them, k being the product of (9) and (10). Dividing by the kernel's mass makes eta = 1 a Gauss-Newton step both
    for a lone particle and in a crowd."""
    g = particles.preshape[i]
    n = float(hand.count[g])
    p = particles.position[i]
    q = particles.rotation[i]
    # Bandwidth by the mean squared distance over log K, the median rule without a sort.
    spread = spread_of(particles.position, start, start + count, lane)
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
        lane,
    )
    drift_t = wp.vec3(sums[0], sums[1], sums[2])
    drift_w = wp.vec3(sums[3], sums[4], sums[5])
    away_t = wp.vec3(sums[6], sums[7], sums[8])
    away_w = wp.vec3(sums[9], sums[10], sums[11])
    mass = sums[12]
    move = (-gamma * drift_t + terms.repulsion * inverse_mass(terms) * away_t / n) / mass
    spin = (-gamma * drift_w + terms.repulsion * hand_turn(hand, g, wp.quat_to_matrix(q), away_w) / n) / mass
    moved = p + shortened(terms.learning_rate * move, terms.longest_step)
    return moved, turn(q, terms.learning_rate * spin)


@wp.kernel
def stein(
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
    gamma: wp.array(dtype=wp.float32),
    group_start: wp.array(dtype=wp.int32),
    group_count: wp.array(dtype=wp.int32),
    particles: Particles,
    position_next: wp.array(dtype=wp.vec3),
    rotation_next: wp.array(dtype=wp.quat),
):
    """So many iterations of the Stein phase, of which `iteration` is the first, in two rounds each: the gradients of
    every particle, with the prior around its seed (eqs. (8), (16) to (18)), and where it moves to. There it goes in the
    round after that, when no other looks at it any more."""
    element = take(queue, wp.tid() / lanes())
    if element < 0:
        return
    lane = wp.tid() % lanes()
    n = particles.preshape.shape[0]
    i = element % n
    k = element / (2 * n)
    g = particles.preshape[i]
    if (element / n) % 2 == 0:
        p = position_next[i]
        q = rotation_next[i]
        if lane == 0:
            particles.position[i] = p
            particles.rotation[i] = q
        if k == iterations:
            return
        drawn = (iteration + k) * hand.count.shape[0] + g
        batch = wp.vec2i(batch_offset[drawn], batch_size[drawn])
        found = slope_at(
            hand, samples, target, nearest, goals, scene, points, balls, outline, levels, terms, g, p, q, batch, 0, lane
        )
        m = float(hand.count[g])
        by_t = terms.prior_precision * inverse_mass(terms) / m * (p - particles.seed_position[i])
        by_w = terms.prior_concentration / m * prior_slope(particles.seed_rotation[i], q)
        if lane == 0:
            particles.gradient_position[i] = found.by_position + by_t
            particles.gradient_rotation[i] = found.by_rotation + hand_turn(hand, g, wp.quat_to_matrix(q), by_w)
            particles.matching_error[i] = found.error
            particles.loss[i] = found.loss
            particles.colliding[i] = found.colliding
    else:
        p, q = stein_step(hand, terms, gamma[iteration + k], particles, i, group_start[g], group_count[g], lane)
        if lane == 0:
            position_next[i] = p
            rotation_next[i] = q
