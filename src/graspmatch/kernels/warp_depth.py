"""What a depth camera sees of meshes, ray by ray, for CPU and CUDA.

Elements of a launch are pixels, row by row. Positions in the world frame [m].
"""

import warp as wp

from graspmatch.kernels.warp_queue import Queue, take

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

NOTHING = wp.constant(-1)
FARTHEST = wp.constant(100.0)
"""[m]"""


@wp.kernel
def see(
    queue: Queue,
    mesh: wp.uint64,
    face_body: wp.array(dtype=wp.int32),
    R_world_camera: wp.mat33,
    origin: wp.vec3,
    x_in: wp.array(dtype=wp.float32),
    y_in: wp.array(dtype=wp.float32),
    depth_out: wp.array(dtype=wp.float32),
    body_out: wp.array(dtype=wp.int32),
    facing_out: wp.array(dtype=wp.float32),
):
    """Along the ray (x, y, 1) of each pixel: distance along the camera's z axis to the first face, zero for nothing;
    the body of that face; and the cosine between ray and normal, without its sign: scans are open."""
    i = take(queue, wp.tid())
    if i < 0:
        return
    depth_out[i] = 0.0
    body_out[i] = NOTHING
    facing_out[i] = 0.0
    ray = wp.vec3(x_in[i], y_in[i], 1.0)
    length = wp.length(ray)
    if wp.isfinite(length):
        direction = R_world_camera * ray / length
        hit = wp.mesh_query_ray(mesh, origin, direction, FARTHEST)
        if hit.result:
            depth_out[i] = hit.t / length
            body_out[i] = face_body[hit.face]
            facing_out[i] = wp.abs(wp.dot(direction, hit.normal))
