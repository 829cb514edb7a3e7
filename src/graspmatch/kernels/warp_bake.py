"""From the links of a hand to the fields of a preshape, for CPU and CUDA.

Legend: x node, l link, f finger, k closing step, u closing fraction, s way back along the approach.
"""

import warp as wp

from graspmatch.kernels.warp_fields import NEVER, FieldStack, interpolate
from graspmatch.kernels.warp_queue import Queue, take

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.kernel
def mesh_distance(
    queue: Queue,
    mesh: wp.uint64,
    x_in: wp.array(dtype=wp.vec3),
    distance_out: wp.array(dtype=wp.float32),
):
    """Signed distance to a triangle soup, the sign by its winding number: right for open and overlapping meshes."""
    i = take(queue, wp.tid())
    if i < 0:
        return
    x = x_in[i]
    query = wp.mesh_query_point_sign_winding_number(mesh, x, 1.0e6, 2.0, 0.5)
    closest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
    distance_out[i] = query.sign * wp.length(x - closest)


@wp.func
def links_distance(
    stack: FieldStack, T_link_gripper: wp.array(dtype=wp.mat44), begin: int, link: wp.array(dtype=wp.int32), x: wp.vec3
) -> float:
    """Smallest signed distance of x to the links `link`, posed by the transforms from `begin` on."""
    distance = float(1.0e30)
    for l in range(link.shape[0]):
        distance = wp.min(distance, interpolate(stack, link[l], wp.transform_point(T_link_gripper[begin + link[l]], x)))
    return distance


@wp.kernel
def hand_distance(
    queue: Queue,
    stack: FieldStack,
    T_link_gripper: wp.array(dtype=wp.mat44),
    link: wp.array(dtype=wp.int32),
    x_in: wp.array(dtype=wp.vec3),
    distance_out: wp.array(dtype=wp.float32),
):
    i = take(queue, wp.tid())
    if i < 0:
        return
    distance_out[i] = links_distance(stack, T_link_gripper, 0, link, x_in[i])


@wp.kernel
def corridor_distance(
    queue: Queue,
    hand: FieldStack,
    approach: wp.vec3,
    reach: float,
    step: float,
    x_in: wp.array(dtype=wp.vec3),
    distance_out: wp.array(dtype=wp.float32),
):
    """Smallest distance of x to the hand anywhere on its straight way in."""
    i = take(queue, wp.tid())
    if i < 0:
        return
    distance = float(1.0e30)
    s = float(0.0)
    while s <= reach:
        value = interpolate(hand, 0, x_in[i] + s * approach)
        distance = wp.min(distance, value)
        # Away from the hand the field grows no faster than the way: nothing nearer is skipped.
        s += wp.max(step, value - distance)
    distance_out[i] = distance


@wp.kernel
def closing_arrival(
    queue: Queue,
    stack: FieldStack,
    T_link_gripper: wp.array(dtype=wp.mat44),
    links: int,
    steps: int,
    link: wp.array(dtype=wp.int32),
    x_in: wp.array(dtype=wp.vec3),
    arrival_out: wp.array(dtype=wp.float32),
):
    """Closing fraction at which the finger made of the links `link` first covers x."""
    i = take(queue, wp.tid())
    if i < 0:
        return
    x = x_in[i]
    arrival = float(NEVER)
    before = float(0.0)
    for k in range(steps):
        if arrival == NEVER:
            distance = links_distance(stack, T_link_gripper, k * links, link, x)
            if distance <= 0.0:
                arrival = float(k)
                if k > 0:
                    arrival = float(k) - distance / wp.min(distance - before, -1.0e-9)
                arrival = wp.clamp(arrival / float(steps - 1), 0.0, 1.0)
            before = distance
    arrival_out[i] = arrival


@wp.kernel
def cast_rays(
    queue: Queue,
    mesh: wp.uint64,
    origin_in: wp.array(dtype=wp.vec3),
    direction_in: wp.array(dtype=wp.vec3),
    reach_out: wp.array(dtype=wp.float32),
    face_out: wp.array(dtype=wp.int32),
):
    """Distance [m] to the first hit of each ray (unit direction) and its face; -1 where nothing is hit."""
    i = take(queue, wp.tid())
    if i < 0:
        return
    query = wp.mesh_query_ray(mesh, origin_in[i], direction_in[i], 10.0)
    reach_out[i] = -1.0
    face_out[i] = -1
    if query.result:
        reach_out[i] = query.t
        face_out[i] = query.face
