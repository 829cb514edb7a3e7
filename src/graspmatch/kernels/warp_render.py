"""A small ray tracer: primary rays, light gathered at the hits, shading with an edge-aware average of that light.

Four samples a pixel, on a rotated grid, each of which casts a few rays (see `warp_rays`).
Elements of a launch are samples (of `shade`: pixels), row by row. Rows are visited in strides of `row_stride`, coprime
to their number, so that equal shares of a launch cost about the same: the sky on top is cheap, the hand is not.
"""

import warp as wp

from graspmatch.kernels.warp_queue import Queue, take
from graspmatch.kernels.warp_rays import (
    BACKGROUND,
    FAR,
    FLOOR,
    TILE,
    Setting,
    View,
    floor_distance,
    light_at,
    pattern_rank,
    place,
    ray_direction,
    seen_along,
    smoothstep,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

GHOST_LAYERS = wp.constant(4)
OPEN_SKY = wp.constant(0.8 + 0.2 * 2.0 / 3.0)  # what the floor's cosine-weighted rays find with nothing in the way


@wp.kernel
def find_surfaces(
    queue: Queue,
    mesh: wp.uint64,
    face_body: wp.array(dtype=int),
    corner_normals: wp.array2d(dtype=wp.vec3),
    view: View,
    setting: Setting,
    body_out: wp.array2d(dtype=int),
    position_out: wp.array2d(dtype=wp.vec3),
    normal_out: wp.array2d(dtype=wp.vec3),
):
    """What each sample sees: index of the body, where (a little above the surface) and the shading normal."""
    element = take(queue, wp.tid())
    if element < 0:
        return
    at = place(element, body_out.shape[1], body_out.shape[0], view.row_stride)
    x = at[0]
    y = at[1]
    d = ray_direction(view, x, y)
    body = BACKGROUND
    position = wp.vec3()
    normal = wp.vec3()
    t = floor_distance(d, view, setting)
    if t < FAR:
        body = FLOOR
        normal = setting.up
        position = view.origin + t * d + setting.lift * normal
    seen = seen_along(d, t, mesh, face_body, corner_normals, view, setting)
    if seen.body >= 0:
        body = seen.body
        position = seen.position
        normal = seen.normal
    body_out[y, x] = body
    position_out[y, x] = position
    normal_out[y, x] = normal


@wp.kernel
def gather_light(
    queue: Queue,
    mesh: wp.uint64,
    view: View,
    setting: Setting,
    body_in: wp.array2d(dtype=int),
    position_in: wp.array2d(dtype=wp.vec3),
    normal_in: wp.array2d(dtype=wp.vec3),
    light_out: wp.array2d(dtype=wp.vec2),
):
    """Light that this sample's few rays find."""
    element = take(queue, wp.tid())
    if element < 0:
        return
    at = place(element, body_in.shape[1], body_in.shape[0], view.row_stride)
    x = at[0]
    y = at[1]
    if body_in[y, x] == BACKGROUND:
        return
    light_out[y, x] = light_at(mesh, position_in[y, x], normal_in[y, x], pattern_rank(x, y), setting)


@wp.func
def average_light(
    x: int,
    y: int,
    spacing: int,
    lift: float,
    body_in: wp.array2d(dtype=int),
    position_in: wp.array2d(dtype=wp.vec3),
    normal_in: wp.array2d(dtype=wp.vec3),
    light_in: wp.array2d(dtype=wp.vec2),
) -> wp.vec2:
    """Mean over the tile around the sample's pixel, of samples on the same body, in the same plane; only every
    `spacing`-th sample (1 or 2) has gathered light."""
    body = body_in[y, x]
    p = position_in[y, x]
    n = normal_in[y, x]
    left = x - x % 2 + 2 - spacing - TILE // 2 * spacing
    top = y - y % 2 + 2 - spacing - TILE // 2 * spacing
    total = wp.vec2()
    count = float(0.0)
    # Even bounds keep the lattice of every second sample.
    for j in range(wp.max(top, 0), wp.min(top + spacing * TILE, body_in.shape[0]), spacing):
        for i in range(wp.max(left, 0), wp.min(left + spacing * TILE, body_in.shape[1]), spacing):
            if body_in[j, i] == body:
                step = position_in[j, i] - p
                # Slope against the tangent plane; the lift keeps rounding from mattering at small steps.
                if wp.dot(normal_in[j, i], n) > 0.8 and wp.abs(wp.dot(step, n)) < 0.35 * wp.length(step) + lift:
                    total += light_in[j, i]
                    count += 1.0
    return total / wp.max(count, 1.0)


@wp.func
def reflected(albedo: wp.vec3, n: wp.vec3, d: wp.vec3, sun: float, sky: float, setting: Setting) -> wp.vec3:
    """Radiance that a satin surface sends back along -d."""
    facing = wp.max(wp.dot(n, setting.sun), 0.0) * sun
    diffuse = wp.cw_mul(albedo, facing * setting.sun_colour + sky * setting.sky_colour)
    half = wp.normalize(setting.sun - d)
    highlight = 0.22 * wp.pow(wp.max(wp.dot(n, half), 0.0), 60.0) * facing
    graze = 1.0 - wp.clamp(-wp.dot(n, d), 0.0, 1.0)
    mirror = (0.03 + 0.25 * graze * graze * graze * graze) * sky
    return diffuse + highlight * setting.sun_colour + mirror * setting.sky_colour


@wp.func
def floor_radiance(p: wp.vec3, sun: float, sky: float, behind: wp.vec3, setting: Setting) -> wp.vec3:
    """The floor's colour, darkened by the share of light that is kept from it, fading into the background."""
    facing = wp.dot(setting.up, setting.sun)
    lit = facing * sun * setting.sun_colour + sky * setting.sky_colour
    unshaded = facing * setting.sun_colour + OPEN_SKY * setting.sky_colour
    colour = wp.cw_mul(setting.floor_colour, wp.cw_div(lit, unshaded))
    distance = wp.length(p - setting.floor_centre) / setting.floor_radius
    return wp.lerp(colour, behind, smoothstep(0.45, 1.55, distance))


@wp.func
def seen_through_ghosts(
    behind: wp.vec3,
    depth: float,
    d: wp.vec3,
    view: View,
    setting: Setting,
    ghosts: wp.array(dtype=wp.uint64),
    ghost_rgba: wp.array(dtype=wp.vec4),
) -> wp.vec3:
    """`behind` at `depth`, blended with the nearest surface of each translucent body before it, nearest on top."""
    colour = wp.vec3()
    clear = float(1.0)
    last = float(-1.0)
    for _layer in range(GHOST_LAYERS):
        nearest = depth
        index = int(-1)
        normal = wp.vec3()
        for k in range(ghosts.shape[0]):
            hit = wp.mesh_query_ray(ghosts[k], view.origin, d, nearest)
            if hit.result and hit.t > last:
                nearest = hit.t
                index = k
                normal = hit.normal
        if index < 0:
            break
        last = nearest
        if wp.dot(normal, d) > 0.0:
            normal = -normal
        rgba = ghost_rgba[index]
        graze = 1.0 + wp.dot(normal, d)
        alpha = rgba[3] + (1.0 - rgba[3]) * 0.5 * graze * graze * graze
        albedo = wp.vec3(rgba[0], rgba[1], rgba[2])
        colour += clear * alpha * reflected(albedo, normal, d, 1.0, 0.8, setting)
        clear *= 1.0 - alpha
    return colour + clear * behind


@wp.func
def same_surface(body: int, n: wp.vec3, step: wp.vec3, other_body: int, other_n: wp.vec3, lift: float) -> bool:
    return body == other_body and wp.dot(n, other_n) > 0.98 and wp.abs(wp.dot(step, n)) < 0.2 * wp.length(step) + lift


@wp.kernel
def shade(
    queue: Queue,
    view: View,
    setting: Setting,
    body_rgb: wp.array(dtype=wp.vec3),
    ghosts: wp.array(dtype=wp.uint64),
    ghost_rgba: wp.array(dtype=wp.vec4),
    body_in: wp.array2d(dtype=int),
    position_in: wp.array2d(dtype=wp.vec3),
    normal_in: wp.array2d(dtype=wp.vec3),
    light_in: wp.array2d(dtype=wp.vec2),
    colour_out: wp.array2d(dtype=wp.vec3),
):
    """Linear colours of the four samples of each pixel."""
    element = take(queue, wp.tid())
    if element < 0:
        return
    at = place(element, view.width, view.height, view.row_stride)
    behind = wp.lerp(setting.top_colour, setting.bottom_colour, (float(at[1]) + 0.5) / float(view.height))
    light = wp.vec2()
    light_body = BACKGROUND
    light_normal = wp.vec3()
    light_position = wp.vec3()
    for k in range(4):
        x = 2 * at[0] + k % 2
        y = 2 * at[1] + k // 2
        d = ray_direction(view, x, y)
        body = body_in[y, x]
        p = position_in[y, x]
        n = normal_in[y, x]
        colour = behind
        depth = FAR
        if body != BACKGROUND:
            # The samples of a pixel share one tile: on one surface they also share its average.
            if not same_surface(body, n, p - light_position, light_body, light_normal, setting.lift):
                light = average_light(x, y, 1, setting.lift, body_in, position_in, normal_in, light_in)
                light_body = body
                light_normal = n
                light_position = p
            depth = wp.length(p - view.origin)
            if body == FLOOR:
                colour = floor_radiance(p, light[0], light[1], behind, setting)
            else:
                colour = reflected(body_rgb[body], n, d, light[0], light[1], setting)
        colour_out[y, x] = seen_through_ghosts(colour, depth, d, view, setting, ghosts, ghost_rgba)


@wp.func
def encoded(x: float) -> float:
    """Display value 0 to 255 of a linear one (sRGB)."""
    if x < 0.0031308:
        return 255.0 * 12.92 * x
    return 255.0 * (1.055 * wp.pow(x, 1.0 / 2.4) - 0.055)


@wp.func
def with_shoulder(x: float) -> float:
    """Bright values bend towards 1 instead of being cut there."""
    if x > 0.75:
        return 0.75 + 0.25 * (1.0 - wp.exp(-(x - 0.75) / 0.25))
    return wp.max(x, 0.0)


@wp.kernel
def develop(
    queue: Queue,
    view: View,
    colour_in: wp.array2d(dtype=wp.vec3),
    image_out: wp.array3d(dtype=wp.uint8),
):
    """Pixels from their own four samples and, at a quarter of the weight in each direction, the twelve around them."""
    element = take(queue, wp.tid())
    if element < 0:
        return
    at = place(element, view.width, view.height, view.row_stride)
    total = wp.vec3()
    weights = float(0.0)
    for j in range(4):
        for i in range(4):
            x = 2 * at[0] + i - 1
            y = 2 * at[1] + j - 1
            if x >= 0 and y >= 0 and x < colour_in.shape[1] and y < colour_in.shape[0]:
                weight = float(1.0)
                if i == 0 or i == 3:
                    weight *= 0.25
                if j == 0 or j == 3:
                    weight *= 0.25
                c = colour_in[y, x]
                # Compressed before averaging, so that a bright sample does not outshine the edge it lies on.
                total += weight * wp.vec3(with_shoulder(c[0]), with_shoulder(c[1]), with_shoulder(c[2]))
                weights += weight
    for c in range(3):
        image_out[at[1], at[0], c] = wp.uint8(wp.clamp(encoded(total[c] / weights) + 0.5, 0.0, 255.0))
