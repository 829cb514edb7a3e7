"""Drawing moving bodies again and again before one camera: the ray tracer of `warp_render`, with less work a frame.

Rays of the camera run only in the tiles of the picture that bodies may cover; one sample of a pixel instead of four
gathers light; and the light on the floor, which nearly always is smooth, comes from a lattice on the floor.
"""

import warp as wp

from graspmatch.kernels.warp_queue import Queue, take
from graspmatch.kernels.warp_rays import (
    BACKGROUND,
    FAR,
    TILE,
    Seen,
    Setting,
    View,
    floor_distance,
    light_at,
    pattern_rank,
    place,
    ray_direction,
    seen_along,
)
from graspmatch.kernels.warp_render import (
    OPEN_SKY,
    average_light,
    floor_radiance,
    reflected,
    same_surface,
    with_shoulder,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

REPEAT = wp.constant(-3)
"""Instead of a body: the samples before this one stand for the rest of the pixel too."""


@wp.struct
class FloorLattice:
    """Square of count x count nodes on the floor."""

    corner: wp.vec3
    across: wp.vec3  # unit vectors
    along: wp.vec3
    spacing: float
    count: int


@wp.kernel
def move_vertices(
    queue: Queue,
    vertex_body: wp.array(dtype=int),
    vertices: wp.array(dtype=wp.vec3),
    T_world_body: wp.array(dtype=wp.mat44),
    vertices_world_out: wp.array(dtype=wp.vec3),
):
    i = take(queue, wp.tid())
    if i < 0:
        return
    vertices_world_out[i] = wp.transform_point(T_world_body[vertex_body[i]], vertices[i])


@wp.kernel
def turn_normals(
    queue: Queue,
    face_body: wp.array(dtype=int),
    normals: wp.array2d(dtype=wp.vec3),
    T_world_body: wp.array(dtype=wp.mat44),
    normals_world_out: wp.array2d(dtype=wp.vec3),
):
    i = take(queue, wp.tid())
    if i < 0:
        return
    T = T_world_body[face_body[i]]
    for k in range(3):
        normals_world_out[i, k] = wp.transform_vector(T, normals[i, k])


@wp.kernel
def light_floor(
    queue: Queue,
    mesh: wp.uint64,
    setting: Setting,
    lattice: FloorLattice,
    light_out: wp.array2d(dtype=wp.vec2),
):
    """Light that a sixteenth of all patterns finds from each node: any 4 x 4 nodes hold them all."""
    element = take(queue, wp.tid())
    if element < 0:
        return
    i = element % lattice.count
    j = element // lattice.count
    offset = float(i) * lattice.across + float(j) * lattice.along
    p = lattice.corner + lattice.spacing * offset + setting.lift * setting.up
    rank = pattern_rank(i, j) // 4
    light = wp.vec2()
    for k in range(4):
        light += 0.25 * light_at(mesh, p, setting.up, 4 * rank + k, setting)
    light_out[j, i] = light


@wp.kernel
def soften_floor(
    queue: Queue,
    lattice: FloorLattice,
    light_in: wp.array2d(dtype=wp.vec2),
    light_out: wp.array2d(dtype=wp.vec2),
):
    """Mean of 4 x 4 nodes, valid half a node before the node that it is written to."""
    element = take(queue, wp.tid())
    if element < 0:
        return
    i = element % lattice.count
    j = element // lattice.count
    total = wp.vec2()
    for b in range(4):
        for a in range(4):
            x = wp.clamp(i + a - 2, 0, lattice.count - 1)
            y = wp.clamp(j + b - 2, 0, lattice.count - 1)
            total += light_in[y, x]
    light_out[j, i] = total / 16.0


@wp.kernel
def see_bodies(
    queue: Queue,
    tiles: wp.array(dtype=wp.vec2i),
    mesh: wp.uint64,
    face_body: wp.array(dtype=int),
    corner_normals: wp.array2d(dtype=wp.vec3),
    view: View,
    setting: Setting,
    body_out: wp.array2d(dtype=int),
    position_out: wp.array2d(dtype=wp.vec3),
    normal_out: wp.array2d(dtype=wp.vec3),
    light_out: wp.array2d(dtype=wp.vec2),
):
    """What the four samples of the pixels of some tiles see, bodies first, and the light at the first sample."""
    element = take(queue, wp.tid())
    if element < 0:
        return
    tile = tiles[element // (TILE * TILE)]
    column = tile[0] * TILE + element % TILE
    row = tile[1] * TILE + element // TILE % TILE
    if column >= view.width or row >= view.height:
        return
    first_seen = Seen()
    found = int(0)
    is_decided = bool(False)
    for m in range(4):
        if m == 2 and found == 0:
            is_decided = True
        if not is_decided:
            k = 3 * m % 4  # one diagonal first: where both of its ends see one surface, or nothing, so do the others
            d = ray_direction(view, 2 * column + k % 2, 2 * row + k // 2)
            seen = seen_along(d, floor_distance(d, view, setting), mesh, face_body, corner_normals, view, setting)
            if seen.body >= 0:
                x = 2 * column + found % 2
                y = 2 * row + found // 2
                body_out[y, x] = seen.body
                position_out[y, x] = seen.position
                normal_out[y, x] = seen.normal
                if found == 0:
                    first_seen = seen
                    light_out[y, x] = light_at(mesh, seen.position, seen.normal, pattern_rank(column, row), setting)
                elif m == 1:
                    step = seen.position - first_seen.position
                    is_decided = same_surface(
                        seen.body, seen.normal, step, first_seen.body, first_seen.normal, setting.lift
                    )
                found += 1
    for k in range(found, 4):
        body_out[2 * row + k // 2, 2 * column + k % 2] = wp.where(found == 2 and is_decided, REPEAT, BACKGROUND)


@wp.func
def floor_light_at(p: wp.vec3, lattice: FloorLattice, light: wp.array2d(dtype=wp.vec2)) -> wp.vec2:
    """Between four nodes; unshaded beyond the lattice."""
    u = wp.dot(p - lattice.corner, lattice.across) / lattice.spacing + 0.5
    v = wp.dot(p - lattice.corner, lattice.along) / lattice.spacing + 0.5
    last = float(lattice.count) - 1.001
    if u < 0.0 or v < 0.0 or u > last or v > last:
        return wp.vec2(1.0, OPEN_SKY)
    i = int(u)
    j = int(v)
    upper = wp.lerp(light[j, i], light[j, i + 1], u - float(i))
    lower = wp.lerp(light[j + 1, i], light[j + 1, i + 1], u - float(i))
    return wp.lerp(upper, lower, v - float(j))


@wp.func
def backdrop(
    column: int, row: int, view: View, setting: Setting, lattice: FloorLattice, floor_light: wp.array2d(dtype=wp.vec2)
) -> wp.vec3:
    """Floor or background of a pixel."""
    behind = wp.lerp(setting.top_colour, setting.bottom_colour, (float(row) + 0.5) / float(view.height))
    d = wp.normalize(view.corner + (float(column) + 0.5) * view.right + (float(row) + 0.5) * view.down)
    distance = floor_distance(d, view, setting)
    if distance >= FAR:
        return behind
    p = view.origin + distance * d
    light = floor_light_at(p, lattice, floor_light)
    return floor_radiance(p, light[0], light[1], behind, setting)


@wp.func
def compressed(colour: wp.vec3) -> wp.vec3:
    return wp.vec3(with_shoulder(colour[0]), with_shoulder(colour[1]), with_shoulder(colour[2]))


@wp.kernel
def paint(
    queue: Queue,
    view: View,
    setting: Setting,
    body_rgb: wp.array(dtype=wp.vec3),
    display: wp.array(dtype=wp.uint8),
    is_tile_seen: wp.array2d(dtype=wp.uint8),
    lattice: FloorLattice,
    floor_light: wp.array2d(dtype=wp.vec2),
    body_in: wp.array2d(dtype=int),
    position_in: wp.array2d(dtype=wp.vec3),
    normal_in: wp.array2d(dtype=wp.vec3),
    light_in: wp.array2d(dtype=wp.vec2),
    image_out: wp.array3d(dtype=wp.uint8),
):
    """Pixels from their four samples, of which those without a body share one backdrop."""
    element = take(queue, wp.tid())
    if element < 0:
        return
    at = place(element, view.width, view.height, view.row_stride)
    total = wp.vec3()
    samples = float(0.0)
    if is_tile_seen[at[1] // TILE, at[0] // TILE] != wp.uint8(0):
        light = wp.vec2()
        light_from = Seen()
        light_from.body = BACKGROUND
        body = int(0)
        for k in range(4):
            x = 2 * at[0] + k % 2
            y = 2 * at[1] + k // 2
            if body >= 0:
                body = body_in[y, x]
            if body >= 0:
                p = position_in[y, x]
                n = normal_in[y, x]
                step = p - light_from.position
                if not same_surface(body, n, step, light_from.body, light_from.normal, setting.lift):
                    light = average_light(x, y, 2, setting.lift, body_in, position_in, normal_in, light_in)
                    light_from.body = body
                    light_from.position = p
                    light_from.normal = n
                d = wp.normalize(p - view.origin)
                total += compressed(reflected(body_rgb[body], n, d, light[0], light[1], setting))
                samples += 1.0
        if body == REPEAT:
            total *= 2.0
            samples = 4.0
    if samples < 4.0:
        total += (4.0 - samples) * compressed(backdrop(at[0], at[1], view, setting, lattice, floor_light))
    for c in range(3):
        linear = wp.clamp(0.25 * total[c], 0.0, 1.0)
        image_out[at[1], at[0], c] = display[int(linear * float(display.shape[0] - 1) + 0.5)]
