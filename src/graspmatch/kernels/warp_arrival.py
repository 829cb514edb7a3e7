"""When the surface of a closing finger arrives at points, and along which way, for CPU and CUDA.

Legend: u = A x + b a point in node units, g the grid of one finger of a preshape, t closing fraction at which the
finger covers a point: its level sets are the finger's surface on its way; e the place of a point in a list.
"""

import warp as wp

from graspmatch.kernels.warp_fields import NEVER, FieldStack, is_inside, low_node

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.func
def arrival_at(stack: FieldStack, g: int, u: wp.vec3) -> float:
    """Closing fraction at which a finger covers a point, `NEVER` outside of the grid: trilinear where all eight nodes
    are covered, else that of the nearest node, since the field jumps to `NEVER` at the edge of what the finger sweeps.
    """
    dims = stack.dims[g]
    if not is_inside(u, dims):
        return float(NEVER)
    low = low_node(u, dims)
    f = u - wp.vec3(float(low[0]), float(low[1]), float(low[2]))
    dx = dims[1] * dims[2]
    dy = dims[2]
    at = stack.start[g] + low[0] * dx + low[1] * dy + low[2]
    v000 = stack.values[at]
    v001 = stack.values[at + 1]
    v010 = stack.values[at + dy]
    v011 = stack.values[at + dy + 1]
    v100 = stack.values[at + dx]
    v101 = stack.values[at + dx + 1]
    v110 = stack.values[at + dx + dy]
    v111 = stack.values[at + dx + dy + 1]
    largest = wp.max(wp.max(wp.max(v000, v001), wp.max(v010, v011)), wp.max(wp.max(v100, v101), wp.max(v110, v111)))
    if largest < NEVER:
        v00 = wp.lerp(v000, v100, f[0])
        v01 = wp.lerp(v001, v101, f[0])
        v10 = wp.lerp(v010, v110, f[0])
        v11 = wp.lerp(v011, v111, f[0])
        return wp.lerp(wp.lerp(v00, v10, f[1]), wp.lerp(v01, v11, f[1]), f[2])
    nearest = wp.where(f[0] >= 0.5, dx, 0) + wp.where(f[1] >= 0.5, dy, 0) + wp.where(f[2] >= 0.5, 1, 0)
    return stack.values[at + nearest]


@wp.func
def arrivals(
    stack: FieldStack,
    g: int,
    A: wp.mat33,
    b: wp.vec3,
    points: wp.array(dtype=wp.float32),
    listed: wp.array(dtype=wp.int32),
    begin: int,
    end: int,
    t_out: wp.array(dtype=wp.float32),
    slowness_out: wp.array2d(dtype=wp.float32),
):
    """`arrival_at` for the points of a list from `begin` to `end`, and for each the gradient of the field there: along
    the way of the finger's surface, the closing fraction that it takes for each node; and its length."""
    look_up_arrivals(
        NEVER, stack.start[g], stack.dims[g], stack.values, A, b, points, listed, begin, end, t_out, slowness_out
    )


@wp.func_native("""
    const float* v = values.data + start;
    const float* coordinates = points.data;
    const int* list = listed.data;
    float* t = t_out.data;
    float* s0 = slowness_out.data;
    float* s1 = s0 + slowness_out.shape[1];
    float* s2 = s1 + slowness_out.shape[1];
    float* size = s2 + slowness_out.shape[1];
    const int nx = dims[0], ny = dims[1], nz = dims[2], dx = ny * nz, dy = nz;
#if defined(__clang__)
#pragma clang loop vectorize(assume_safety)
#endif
    for (int e = begin; e < end; ++e) {
        int first = (list[e] >> 5) * 96 + (list[e] & 31);
        float x = coordinates[first], y = coordinates[first + 32], z = coordinates[first + 64];
        float u0 = A.data[0][0] * x + A.data[0][1] * y + A.data[0][2] * z + b[0];
        float u1 = A.data[1][0] * x + A.data[1][1] * y + A.data[1][2] * z + b[1];
        float u2 = A.data[2][0] * x + A.data[2][1] * y + A.data[2][2] * z + b[2];
        bool inside = u0 >= 0.0f & u1 >= 0.0f & u2 >= 0.0f & u0 <= nx - 1 & u1 <= ny - 1 & u2 <= nz - 1;
        int i = wp::min(wp::max((int)u0, 0), nx - 2);
        int j = wp::min(wp::max((int)u1, 0), ny - 2);
        int k = wp::min(wp::max((int)u2, 0), nz - 2);
        float f0 = u0 - i, f1 = u1 - j, f2 = u2 - k;
        int at = i * dx + j * dy + k;
        float v000 = v[at], v001 = v[at + 1], v010 = v[at + dy], v011 = v[at + dy + 1];
        float v100 = v[at + dx], v101 = v[at + dx + 1], v110 = v[at + dx + dy], v111 = v[at + dx + dy + 1];
        float largest = wp::max(wp::max(wp::max(v000, v001), wp::max(v010, v011)),
                                wp::max(wp::max(v100, v101), wp::max(v110, v111)));
        float v00 = v000 + (v100 - v000) * f0, v01 = v001 + (v101 - v001) * f0;
        float v10 = v010 + (v110 - v010) * f0, v11 = v011 + (v111 - v011) * f0;
        float v0 = v00 + (v10 - v00) * f1, v1 = v01 + (v11 - v01) * f1;
        float smooth = v0 + (v1 - v0) * f2;
        float nearest = v[at + (f0 >= 0.5f ? dx : 0) + (f1 >= 0.5f ? dy : 0) + (f2 >= 0.5f ? 1 : 0)];
        t[e] = inside ? (largest < never ? smooth : nearest) : never;

        i = wp::min(wp::max((int)(u0 + 0.5f), 1), nx - 2);
        j = wp::min(wp::max((int)(u1 + 0.5f), 1), ny - 2);
        k = wp::min(wp::max((int)(u2 + 0.5f), 1), nz - 2);
        at = i * dx + j * dy + k;
        float here = v[at];
        float a0 = v[at - dx], b0 = v[at + dx], a1 = v[at - dy], b1 = v[at + dy], a2 = v[at - 1], b2 = v[at + 1];
        float known = here < never ? 1.0f : 0.0f;
        float scale0 = (a0 < never & b0 < never) ? 0.5f : 1.0f;
        float scale1 = (a1 < never & b1 < never) ? 0.5f : 1.0f;
        float scale2 = (a2 < never & b2 < never) ? 0.5f : 1.0f;
        float g0 = known * scale0 * ((b0 < never ? b0 : here) - (a0 < never ? a0 : here));
        float g1 = known * scale1 * ((b1 < never ? b1 : here) - (a1 < never ? a1 : here));
        float g2 = known * scale2 * ((b2 < never ? b2 : here) - (a2 < never ? a2 : here));
        s0[e] = g0;
        s1[e] = g1;
        s2[e] = g2;
#if defined(__CUDA_ARCH__)
        size[e] = sqrtf(g0 * g0 + g1 * g1 + g2 * g2);
#else
        size[e] = __builtin_elementwise_sqrt(g0 * g0 + g1 * g1 + g2 * g2);
#endif
    }
""")
def look_up_arrivals(
    never: float,
    start: int,
    dims: wp.vec3i,
    values: wp.array(dtype=wp.float32),
    A: wp.mat33,
    b: wp.vec3,
    points: wp.array(dtype=wp.float32),
    listed: wp.array(dtype=wp.int32),
    begin: int,
    end: int,
    t_out: wp.array(dtype=wp.float32),
    slowness_out: wp.array2d(dtype=wp.float32),
):
    """`arrivals` in C++, so that a CPU looks at 8 points at once. The gradient is one of central differences at
    the nearest node, one-sided where the finger never gets to one side, zero where it never gets."""
    ...
